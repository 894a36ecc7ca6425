"""What is tuned of each kind of controller, and in which range.

A gain that may be given for each joint or state is tuned as one number for all of them; one whose
default differs between them is tuned as a factor of that default. Ranges are wide: decades around
the kind's default, which is in every range, since it is the first trial. Feedback on the error has
the same freedom in all kinds: a position and a velocity gain, an integral's too where the law has
one. Whole numbers (units of a network, states remembered) are not tuned, nor is what is off by
default: no trial would tell it from chance.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from dnnmso_mj.tuning import TuneError


class Range(NamedTuple):
    """Where a number is sought, both ends included; by its logarithm where `log`.

    A `factor` is sought of a list of numbers, all multiplied by it; it starts at 1.
    """

    low: float
    high: float
    log: bool = True
    factor: bool = False


Space = dict[str, Range]

# Poles from 1/s to 200/s; at 1 kHz faster ones are out of reach. A torque law's gains are those
# times the arm's inertia, which on the paper's motion is between 0.2 and 12 kg·m²: a velocity gain
# of 300 N·m·s/rad makes the lighter direction unstable at 1 kHz.
_INVERSION: Space = {
    "inversion.K": Range(1.0, 200.0),
    "inversion.lam": Range(1.0, 200.0),
}
_ACCELERATION: Space = {"kp": Range(1.0, 4e4), "kd": Range(2.0, 400.0)}
_TORQUE: Space = {"kp": Range(50.0, 1e4), "kd": Range(10.0, 300.0)}
_K2: Space = {"observer.K2": Range(5.0, 500.0)}
_LEARNING: Space = {
    **_K2,
    "madam.eta": Range(1e-5, 1e-2),
    "network.output_scale": Range(0.01, 1.0),
}
_ADAPTIVE: Space = {
    "lam": Range(1.0, 40.0),
    "K_D": Range(0.1, 10.0, factor=True),
    "Gamma": Range(0.01, 100.0, factor=True),
}

# Kind -> key path below `controller` -> range; one entry for every kind there is.
SPACES: dict[str, Space] = {
    "dnn_mso": {**_INVERSION, **_LEARNING},
    "no_network": _INVERSION,
    "classical_mso": {**_INVERSION, **_LEARNING},
    "rbf_mso": {
        **_INVERSION,
        **_K2,
        "width": Range(0.2, 3.0),
        "Gamma": Range(1.0, 1e5),
        "kappa": Range(1e-5, 1.0),
    },
    "dnn_mso_replay": {
        **_INVERSION,
        "K2": Range(5.0, 500.0),
        "madam.eta": Range(1e-5, 1e-2),
        "replay.eta": Range(1e-5, 1e-2),
        "rate.eta_min": Range(1e-6, 1e-3),
    },
    "backstepping": {
        "K_q": Range(1.0, 200.0),
        "K_v": Range(1.0, 200.0),
        "filter_v": Range(5.0, 500.0),
        **_LEARNING,
    },
    "pd": _TORQUE,
    "pid": {**_TORQUE, "ki": Range(50.0, 1e5)},
    "computed_torque": _ACCELERATION,
    "adrc": {
        "controller_bandwidth": Range(3.0, 100.0),
        "observer_bandwidth": Range(20.0, 600.0),
    },
    "sliding_mode": {
        "lam": Range(1.0, 100.0),
        "gain": Range(5.0, 200.0),
        "boundary_layer": Range(0.02, 5.0),
    },
    "rise": {
        "ks": Range(10.0, 300.0),
        "alpha1": Range(1.0, 40.0),
        "alpha2": Range(1.0, 40.0),
        "beta": Range(1.0, 300.0),
    },
    "l1": {
        **_ACCELERATION,
        "predictor_gain": Range(0.1, 20.0),
        "filter_bandwidth": Range(5.0, 400.0),
    },
    "slotine_li": _ADAPTIVE,
    "concurrent_learning": {
        **_ADAPTIVE,
        "k_CL": Range(0.3, 3000.0),
        "window": Range(0.01, 1.0),
    },
    "lewis_nn": {
        "lam": Range(1.0, 40.0),
        "K_v": Range(5.0, 300.0),
        "F": Range(1.0, 1e4),
        "G": Range(0.1, 1e3),
        "kappa": Range(1e-5, 1.0),
    },
}

B = Range(0.02, 5.0)  # 1/(kg·m²) of a constant B₂; between 1/12 and 5 along the paper's motion


def space_of(controller: Mapping[str, Any]) -> Space:
    """What is tuned of a controller's settings: the table of its kind, and a constant B₂.

    Args:
        controller: as a scenario has it, every key there.

    Raises:
        TuneError: a kind that is code of its own.
    """
    kind = controller["kind"]
    if kind not in SPACES:
        raise TuneError(
            f"controller.kind = {kind}: nothing of it is tuned; allowed: {', '.join(SPACES)}"
        )
    space = dict(SPACES[kind])
    for above in ("", "inversion"):
        settings = controller.get(above, {}) if above else controller
        if settings.get("effectiveness", {}).get("kind") == "constant":
            space[f"{above}.effectiveness.b".lstrip(".")] = B
    return space
