"""Runs for the tests of going on from a log; as a program, go on from many ticks of one.

resume_samples.py LOG SEED COUNT resumes LOG at COUNT random ticks, with nothing changed, and prints
what differs. It knows nothing of the run but its log.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from dnnmso_mj.difference import difference
from dnnmso_mj.reading import log_info
from dnnmso_mj.resume import resume

HARD = """
name: hard
duration: 1.12
controller: {kind: dnn_mso_replay}
reference: {kind: sinusoid, phase: [0.0, 1.5707963267948966]}
plant: {model: MODEL, masses: [1.0, 2.3], lengths: [1.0, 1.0], integrator: implicitfast}
imperfections:
  torque_limit: 70.0
  torque_rate: 8000.0
  actuator_lag: 0.003
  actuator_delay: 0.0023
  sensor_delay: 0.0017
  jitter: 0.002
  position_noise: 1.0e-4
  velocity_noise: 1.0e-3
  position_bias: 1.0e-3
  position_drift: 1.0e-3
  velocity_drift: 1.0e-3
  friction: {viscous: 0.1, coulomb: 0.3, breakaway: 0.5}
events:
  - {kind: payload, at: 0.31, mass: 0.5}
  - {kind: push, at: 0.42, duration: 0.7, torque: [3.0, 0.0], force: [4.0, 2.0]}
  - {kind: freeze, at: 1.06, what: model}
"""
PAPER = """
name: paper
duration: 1.12
controller: {kind: dnn_mso}
reference: {kind: sinusoid, phase: [0.0, 1.5707963267948966]}
plant: {model: MODEL, masses: [1.0, 2.3], lengths: [1.0, 1.0]}
"""
SLOW = """
name: slow
duration: 2.4
dt: 0.002
seed: 3
controller: {kind: pid}
reference: {kind: waypoints, times: [0.2, 1.0, 2.2], points: [[0.5, 0.5], [0.8, 0.1], [0.2, 0.3]]}
plant: {model: MODEL, masses: [1.0, 2.3], lengths: [1.0, 1.0], integrator: euler}
imperfections:
  torque_limit: 90.0
  actuator_lag: 0.01
  position_noise: 1.0e-5
  encoder_counts: 65536
  velocity_from: difference
  velocity_filter: 0.004
  friction: {viscous: 0.4, coulomb: 0.2}
events: [{kind: push, at: 1.1, duration: 0.3, torque: [0.0, 9.0]}]
"""
SCENARIOS = {"hard": HARD, "paper": PAPER, "slow": SLOW}


def main(log: Path, seed: int, count: int) -> None:
    """Resume, compare, and say what differs, and how many ticks were tried."""
    info = log_info(log)
    dt = info.duration / info.ticks
    for tick in np.random.default_rng(seed).integers(0, info.ticks, count).tolist():
        out = log.with_name("resumed.mcap")
        resume(log, tick * dt, out=out, force=True)
        found = difference(log, out)
        if not found.equal:
            print(f"tick {tick}: {found.plain()}")
    print(f"{count} ticks")


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]))
