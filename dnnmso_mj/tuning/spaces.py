"""What is tuned of each kind of controller, and in which range.

A gain that may be given for each joint or state is tuned as one number for all of them. Ranges are
wide: decades around the kind's default, which is in every range, since it is the first trial.
"""

from __future__ import annotations

from typing import NamedTuple


class Range(NamedTuple):
    """Where a number is sought, both ends included; by its logarithm where `log`."""

    low: float
    high: float
    log: bool = True


Space = dict[str, Range]

_INVERSION: Space = {
    "inversion.K": Range(1.0, 200.0),
    "inversion.lam": Range(1.0, 200.0),
}
_MSO: Space = {
    **_INVERSION,
    "observer.K2": Range(5.0, 500.0),
    "madam.eta": Range(1e-5, 1e-2),
    "network.output_scale": Range(0.01, 1.0),
}

# Kind -> key path below `controller` -> range; one entry for every kind there is.
SPACES: dict[str, Space] = {
    "dnn_mso": _MSO,
    "no_network": _INVERSION,
    "classical_mso": _MSO,
}
