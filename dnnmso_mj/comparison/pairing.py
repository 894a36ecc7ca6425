"""Two controllers on the same seeds: how much better, how often, and how sure that is."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from dnnmso_mj.sweep.statistics import Spread, spread

Array = np.ndarray


@dataclass(frozen=True)
class Pairing:
    """A controller's runs against those of another with the same seeds; smaller is better.

    Args:
        controller: whose.
        against: whom it is held against.
        log_ratio: of ln(its value / the other's), over seeds; under 0 it is better. -inf: only it
            ended well; inf: only the other did; 0: neither did.
        wins, losses, ties: seeds at which it is better, worse, neither.
        p: that the log ratios are symmetric about 0; Wilcoxon's signed-rank test, two-sided.
        p_holm: p after Holm's correction for all pairings of the comparison.
    """

    controller: str
    against: str
    log_ratio: Spread
    wins: int
    losses: int
    ties: int
    p: float
    p_holm: float


def pair(controller: str, against: str, values: Array, others: Array) -> Pairing:
    """Hold one controller against another.

    Args:
        controller, against: their names.
        values, others: of each seed, both in the same order, shape (n,), >= 0; inf where a run did
            not end well, which is worse than every number and as bad as another such run.

    Returns:
        The pairing; its p_holm is its p, until `corrected` knows of the others.
    """
    ratios = log_ratios(values, others)
    wins, losses = int((ratios < 0).sum()), int((ratios > 0).sum())
    p = signed_rank_p(ratios)
    ties = len(ratios) - wins - losses
    return Pairing(controller, against, spread(ratios), wins, losses, ties, p, p)


def log_ratios(values: Array, others: Array) -> Array:
    """ln(values / others), shape (n,); 0 where both are the same, 0 and inf too."""
    same = values == others
    with np.errstate(divide="ignore"):
        ratios: Array = np.log(np.where(same, 1.0, values)) - np.log(np.where(same, 1.0, others))
    return ratios


def signed_rank_p(differences: Array) -> float:
    """Two-sided p of Wilcoxon's signed-rank test that differences are symmetric about 0.

    Zeros say nothing and are left out, as in Wilcoxon's own (Biometrics Bulletin 1, 1945);
    infinite differences share the highest rank. 1 where nothing is left.
    """
    told = differences[differences != 0]
    if told.size == 0:
        return 1.0
    finite = np.abs(told[np.isfinite(told)])
    beyond = 2.0 * finite.max() if finite.size else 1.0
    ranked = np.clip(told, -beyond, beyond)
    return float(stats.wilcoxon(ranked).pvalue)


def corrected(pairings: Sequence[Pairing]) -> list[Pairing]:
    """The same with Holm's step-down correction (Scand. J. Statistics 6, 1979) for all of them.

    Of m ordered p: max over j <= i of (m - j) p_j, j from 0, at most 1.
    """
    order = sorted(range(len(pairings)), key=lambda k: pairings[k].p)
    adjusted = [math.nan] * len(pairings)
    largest = 0.0
    for j, k in enumerate(order):
        largest = max(largest, min(1.0, (len(pairings) - j) * pairings[k].p))
        adjusted[k] = largest
    return [replace(item, p_holm=p) for item, p in zip(pairings, adjusted, strict=True)]
