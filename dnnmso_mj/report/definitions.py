"""What the numbers of a report mean, in words that need no other page."""

from __future__ import annotations

from collections.abc import Mapping

# name -> unit, meaning; the names are `compute_metrics`' own.
METRICS: Mapping[str, tuple[str, str]] = {
    "rmse": ("rad", "Root of the mean square of q − q_ref over all ticks and joints."),
    "rmse_steady": ("rad", "Root of the mean square of q − q_ref over joints and the last half."),
    "max_abs_error_steady": ("rad", "Largest |q − q_ref| of any joint in the last half."),
    "tau_peak": ("N·m", "Largest torque that was applied to any joint."),
    "tau_chatter": (
        "N·m a step",
        "Mean change of torque from one tick to the next, over joints and the last half.",
    ),
    "f_err_rms_steady": (
        "rad/s, rad/s²",
        "Root of the mean square of true minus learned dynamics in the last half.",
    ),
    "settling_time": (
        "s",
        "When the error enters for good a band of 2 % of its largest value in the first half.",
    ),
    "bound_violations": ("ticks", "Ticks at which the error exceeds its theoretical bound."),
    "diverged": (
        "",
        "Whether the run was stopped because it left the plausible range or a limit of its joints; "
        "it has no means, steady values or settling time then.",
    ),
    "compute_us_p50": ("µs", "Median of the controller's time a tick."),
    "compute_us_p999": ("µs", "99.9th percentile of the controller's time a tick."),
    "deadline_misses": ("ticks", "Ticks without a command in time."),
}

INTERVAL = (
    "Intervals are 95 % intervals of the median over seeds: by percentile bootstrap, or exact from "
    "order statistics where values are very many or some are infinite. With fewer than six values "
    "there is none."
)
SWEPT = "In a sweep, runs that diverged or failed are listed, and have no part in the statistics."
COMPARED = (
    "In a comparison, a run that diverged or failed counts as infinitely bad (∞) in the ranking "
    "and the pairs. Ratios are taken seed by seed between runs with the same seed, and so the same "
    "noise; under 1 the controller is better. p is of Wilcoxon's signed-rank test, two-sided, on "
    "their logarithms, and p (Holm) is corrected for all pairs of the table."
)
MARGINS = (
    "A margin is the largest value (of the torque limit and of factors below 1: the smallest) that "
    "a controller stands, searched for each seed on its own. It stands a value when the run does "
    "not diverge and rmse_steady, the root mean square error of the last half, is within the "
    "limit. A seed that fails without the imperfection has the margin none, the worst of all. "
    "'>' and '<' mark the end of the search. A search takes it that what stands a value stands all "
    "lesser ones; seeds where probes say otherwise are counted as non-monotone."
)
