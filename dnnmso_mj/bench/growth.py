"""How costs grow: with the network's width and depth, the arm's joints, the number of seeds."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from functools import partial

import numpy as np

from dnnmso_mj.bench.environments import BareMujoco
from dnnmso_mj.bench.step import Make, ours, plain_torch, step_probe
from dnnmso_mj.bench.tick import loop_probe, stepping
from dnnmso_mj.bench.timing import Contender, Probe, Table, race
from dnnmso_mj.plant import Mjcf
from dnnmso_mj.scenario import DnnMso, Initial, Plant, Scenario, Sinusoid
from dnnmso_mj.scenario import Network as NetworkSpec
from dnnmso_mj.sweep.plan import plan_sweep
from dnnmso_mj.sweep.run import make_engine

Array = np.ndarray

WIDTHS = (16, 32, 64, 128, 256)
DEPTHS = (1, 2, 3, 4, 5, 6)
JOINTS = (2, 3, 6, 12)
OURS, OURS_64, PLAIN = "dnnmso_mj, float32", "dnnmso_mj, float64", "plain PyTorch, float32"
LOOP, BARE = "closed loop, learning", "bare mj_step"


def bench_growth(quick: bool) -> list[Table]:
    """Four curves, each table one."""
    calls, rounds = (20, 2) if quick else (300, 8)
    widths = [(width, (width,) * 3) for width in WIDTHS]
    depths = [(depth, (64,) * depth) for depth in DEPTHS]
    return [
        _step_table("width", "of three hidden layers", "units", widths, calls, rounds),
        _step_table("depth", "in hidden layers of 64", "layers", depths, calls, rounds),
        _joints_table(quick),
        _seeds_table(quick),
    ]


def _step_table(
    what: str,
    of: str,
    unit: str,
    networks: Iterable[tuple[int, tuple[int, ...]]],
    calls: int,
    rounds: int,
) -> Table:
    contenders = []
    for size, hidden in networks:
        single = NetworkSpec(hidden=hidden, precision="float32")
        double = NetworkSpec(hidden=hidden, precision="float64")
        kinds: list[tuple[str, Make, NetworkSpec]] = [
            (OURS, ours, single),
            (OURS_64, ours, double),
            (PLAIN, plain_torch, single),
        ]
        for curve, make, network in kinds:
            contenders.append(
                Contender(
                    name=f"{size} {unit}: {curve}",
                    bounded_by="the interpreter" if curve == PLAIN else "number of weights",
                    make=partial(step_probe, make, network, calls),
                    versus=f"{size} {unit}: {OURS}",
                    curve=curve,
                    at=size,
                )
            )
    return Table(
        name=f"growth_{what}",
        title=f"Control step against {what} {of}",
        work="as in `step`",
        unit="µs",
        rows=race(contenders, rounds),
        axis=f"{what}, {unit}",
    )


def _joints_table(quick: bool) -> Table:
    ticks, rounds = (50, 2) if quick else (500, 5)
    contenders = []
    for n in JOINTS:
        scenario, mjcf = chain_scenario(n, ticks), chain_arm(n)
        q, still = np.array(scenario.initial.q), np.zeros((ticks, n))
        arm = partial(BareMujoco, mjcf.text, q, np.zeros(n))
        makes: list[tuple[str, str, Callable[[], Probe]]] = [
            (LOOP, "the network's step, then MuJoCo", partial(loop_probe, scenario, mjcf)),
            (BARE, "MuJoCo: Runge-Kutta 4", partial(stepping, arm, still)),
        ]
        for curve, bound, make in makes:
            name, versus = f"{n} joints: {curve}", f"{n} joints: {LOOP}"
            contenders.append(Contender(name, bound, make, versus, curve, n))
    return Table(
        name="growth_joints",
        title="One tick against the number of joints of a chain",
        work="64-64-64 network in float32, RK4 at 1 ms, B from M(q); mj_step holds zero torque",
        unit="µs",
        rows=race(contenders, rounds),
        axis="joints",
    )


def chain_arm(n: int) -> Mjcf:
    """A planar chain of n uniform rods, 1 m and 3.3 kg together."""
    length, mass = 1.0 / n, 3.3 / n
    inertia = mass * length**2 / 12
    bodies, ends = "", ""
    for k in range(1, n + 1):
        start = 0.0 if k == 1 else length
        bodies += (
            f'<body name="link{k}" pos="{start} 0 0">'
            f'<inertial pos="{length / 2} 0 0" mass="{mass}"'
            f' diaginertia="{inertia * 1e-3} {inertia} {inertia}"/>'
            f'<joint name="joint{k}" axis="0 -1 0"/>'
            f'<geom name="rod{k}" type="capsule" fromto="0 0 0 {length} 0 0" size="0.01" mass="0"/>'
        )
        ends += "</body>"
    motors = "".join(f'<motor name="motor{k}" joint="joint{k}"/>' for k in range(1, n + 1))
    flags = '<flag contact="disable" constraint="disable" autoreset="disable"/>'
    return Mjcf(
        f'<mujoco model="chain{n}"><compiler angle="radian" inertiafromgeom="false"/>'
        f'<option timestep="0.001" integrator="RK4">{flags}</option>'
        f"<worldbody>{bodies}{ends}</worldbody><actuator>{motors}</actuator></mujoco>"
    )


def chain_scenario(n: int, ticks: int) -> Scenario:
    """The paper's controller on that chain, each joint on a slow sine."""
    return Scenario(
        name=f"chain{n}",
        duration=ticks * 1e-3,
        plant=Plant(model=f"chain{n}", masses=None, lengths=None),
        initial=Initial(q=(0.0,) * n),
        reference=Sinusoid(kind="sinusoid", amplitude=(0.2,)),
        controller=DnnMso(kind="dnn_mso", network=NetworkSpec(precision="float32")),
    )


def _seeds_table(quick: bool) -> Table:
    ticks, rounds = (100, 1) if quick else (1000, 2)
    contenders = [
        Contender(
            name=f"{seeds} seeds",
            bounded_by="start of the workers" if seeds <= 10 else "cores",
            make=partial(_sweep_probe, ticks, seeds),
            curve="dnnmso sweep",
            at=seeds,
        )
        for seeds in ((2, 10) if quick else (10, 30, 100, 300))
    ]
    return Table(
        name="growth_seeds",
        title=f"Sweep against the number of seeds, {ticks} ticks a run",
        work="from the start of the workers to the last row, metrics included, on all cores",
        unit="ticks/s",
        rows=race(contenders, rounds, more_is_better=True, warm=False),
        axis="seeds",
    )


def _sweep_probe(ticks: int, seeds: int) -> Probe:
    def probe() -> Array:
        plan = plan_sweep("paper", range(seeds), [f"duration={ticks * 1e-3}"])
        began = time.perf_counter()
        done = sum(row["ticks"] for row in make_engine().rows(plan.tasks([set()])))
        return np.array([done / (time.perf_counter() - began)])

    return probe
