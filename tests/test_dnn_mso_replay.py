"""The controller with memory: its labels, its feed-forward, its bound, and what it has learned."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from dnnmso_mj.bench.growth import chain_arm, chain_scenario
from dnnmso_mj.controllers import MODEL_ALONE, MODEL_FROZEN, Inputs, build_controller
from dnnmso_mj.dynamics import TwoLink
from dnnmso_mj.errors import ScenarioError
from dnnmso_mj.loading import load_scenario
from dnnmso_mj.memory import CLOCK, SIZE
from dnnmso_mj.memory_recorder import MemoryRecorder
from dnnmso_mj.scenario import DnnMsoReplay, Scenario
from dnnmso_mj.simulation import Simulation, simulate

Array = np.ndarray
KIND = "dnn_mso_replay"
ARM = TwoLink((1.0, 2.3), (1.0, 1.0))
LOADED = TwoLink((1.0, 3.5), (1.0, 1.0))
DT, GAIN, LAM = 1e-3, 7.5, 7.5
K2 = DnnMsoReplay(kind=KIND).K2[0]
SHARE = K2 * DT  # of the newest value in the observer's lag
CLOCKED = {"compute_us", "deadline_missed", "wake_late_us"}
REPLAY_ERROR = 0.5  # rad/s², from which on replay learns as fast as it may
PAYLOAD = {"kind": "payload", "at": 8.0, "mass": 1.2}
FAST = {"kind": "sinusoid", "frequency": 2.0, "amplitude": 0.5, "phase": [0.0, 1.57]}


@dataclass
class Watched:
    """A controller with its inner columns written down after each tick."""

    controller: object
    told: bool = True  # whether it is told what acted
    columns: dict[str, list[Array]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.n_layers = self.controller.n_layers
        self._last = np.zeros(2)

    def __getattr__(self, name):
        return getattr(self.controller, name)

    def update(self, inputs):
        if not self.told:
            inputs.tau[:] = self._last
        command = self.controller.update(inputs)
        self._last[:] = command.tau
        law = self.controller.ticks.parts.law
        for name in ("label", "z", "d_hat", "acted", "M", "x_lagged"):
            self.columns.setdefault(name, []).append(getattr(law, name).copy())
        for name, value in (
            ("replay_eta", self.controller.ticks.parts.net.settings[0]),
            ("replay_sq", law.replay_sq[0]),
            ("remembered", law.memory.counts[SIZE]),
            ("x", inputs.x.copy()),
        ):
            self.columns.setdefault(name, []).append(value)
        return command

    def __getitem__(self, name: str) -> Array:
        return np.array(self.columns[name])


def watched_run(scenario, mjcf, **how):
    simulation = Simulation(scenario, mjcf)
    simulation.controller = seen = Watched(simulation.controller, **how)
    recorder = MemoryRecorder(simulation.layout, scenario.n_ticks)
    return recorder.trace(scenario, simulation.run(recorder)), seen


def spec(**settings):
    return {"kind": KIND} | settings


def error(trace) -> Array:
    return trace["q"] - trace["q_ref"]


def rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


@pytest.fixture(scope="module")
def seen(make_scenario, two_link):
    """The paper's run, watched: noise, a limit that acts, learning until the end."""
    imperfections = {"velocity_noise": 1e-3, "torque_limit": 70.0}
    scenario = make_scenario(spec(), duration=4.0, imperfections=imperfections)
    trace, watched = watched_run(scenario, two_link)
    assert trace.info.status == "ok"
    assert trace["saturated"].any()
    return trace, watched


def implied(watched) -> Array:
    """f(k) (N − 1, n) = (q̇(k+1) − q̇(k))/dt − B₂ τ, of what was read and what acted."""
    n = watched["label"].shape[1]
    qd = watched["x"][:, n:]
    effect = np.linalg.solve(watched["M"][:-1], watched["acted"][1:, :, None])[..., 0]
    return np.diff(qd, axis=0) / DT - effect


def lagged(values: Array, first: Array) -> Array:
    """y(k+1) = y(k) + K₂dt (v(k) − y(k)), y(0) = first."""
    out = [first]
    for value in values:
        out.append(out[-1] + SHARE * (value - out[-1]))
    return np.array(out)


def test_a_label_is_the_plants_own_dynamics_through_the_observers_lag(seen):
    """y = LP[f̂] + K₂ e_a = LP[f], whatever the network says, under limits and noise."""
    trace, watched = seen
    label, f_hat = watched["label"], trace["f_hat"][:, 2:]
    true = lagged(implied(watched), f_hat[0])
    size = np.abs(label).max()
    assert np.abs(label - true).max() < 1e-9 * size
    flipped = label - 2.0 * watched["z"]  # LP[f̂] − K₂ e_a
    assert np.abs(flipped - true)[100:].max() > 0.01 * size


def test_a_label_belongs_to_the_state_through_the_same_lag(seen):
    _, watched = seen
    x = watched["x"]
    assert np.allclose(watched["x_lagged"], lagged(x, x[0])[1:], rtol=1e-12, atol=1e-12)


def test_nothing_is_remembered_but_labels_at_their_states(seen):
    _, watched = seen
    memory = watched.controller.ticks.parts.law.memory
    size = memory.counts[SIZE]
    assert size == watched["remembered"][-1] > 100
    pairs = np.hstack([watched["x_lagged"][:-1], watched["label"][1:]])
    known = {row.tobytes() for row in pairs}
    known.add(np.hstack([watched["x"][0], watched["label"][0]]).tobytes())
    kept = np.hstack([memory.x[:size], memory.label[:size]])
    assert all(row.tobytes() in known for row in kept)


@pytest.mark.parametrize("order", [0, 1, 2])
def test_the_feed_forward_leaves_a_filtered_difference_of_the_models_error(
    make_scenario, two_link, order
):
    """f̃ − d̂ = (1 − LP)^order f̃, exactly: 1 − LP = (1 − q)/(1 − (1 − K₂dt) q), q a tick's delay."""
    scenario = make_scenario(spec(feed_forward=order), duration=0.5)
    trace, watched = watched_run(scenario, two_link)
    f_err = implied(watched) - trace["f_hat"][:-1, 2:]
    expected = f_err
    for _ in range(order):
        expected = expected - lagged(expected, np.zeros(2))[:-1]
    left = f_err - watched["d_hat"][:-1]
    assert np.abs(left - expected).max() < 1e-9 * np.abs(f_err).max()
    other = expected - lagged(expected, np.zeros(2))[:-1]
    assert np.abs(left - other)[50:].max() > 1e-2


# ---- the claim that needs no learning ----


@pytest.fixture(scope="module")
def run(make_scenario, two_link):
    """Runs of 9 s, frozen from the 5th on or learning throughout, by order of the feed-forward."""
    done: dict[tuple[int, bool], object] = {}

    def of(order: int, frozen: bool):
        if (order, frozen) not in done:
            events = [{"kind": "freeze", "at": 5.0, "what": "model"}] if frozen else []
            scenario = make_scenario(spec(feed_forward=order), duration=9.0, events=events)
            done[order, frozen] = simulate(scenario, two_link, watch=False)
        return done[order, frozen]

    return of


def bounds(trace, first: float) -> tuple[float, float, float]:
    """What docs/dnn_mso_replay.md claims of |e_i| after a time, for orders 0, 1 and 2 (rad).

    Sup of f̃ and of its differences over that time and the second before, in which what came
    earlier dies away, and dt/2 (‖q⃛_ref‖ + λ‖ë‖) for the sampling.
    """
    f_err = (trace["f_true"] - trace["f_hat"])[round((first - 1.0) / DT) :, 2:]
    qd_error = (trace["qd"] - trace["qd_ref"])[round((first - 1.0) / DT) :]
    sampling = 0.5 * DT * (0.125 + LAM * np.abs(np.diff(qd_error, axis=0)).max() / DT)
    found = []
    for order in range(3):
        rate = np.abs(np.diff(f_err, n=order, axis=0)).max() / SHARE**order
        found.append((rate + sampling) / (GAIN * LAM))
    return found[0], found[1], found[2]


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("frozen", [True, False])
def test_the_error_keeps_its_bound_from_the_models_error_alone(run, order, frozen):
    """|e_i| ≤ ρ/(K₂ K λ), or ρ₂/(K₂² K λ): a frozen model or one that learns, right or wrong."""
    trace = run(order, frozen)
    worst = np.abs(error(trace)[6500:]).max()
    bound = bounds(trace, 6.5)
    assert worst <= bound[order]
    if frozen:
        assert worst > 0.1 * bound[order]  # the bound says something


def test_a_law_of_lower_order_breaks_the_bound_of_a_higher_one(run):
    for order in (0, 1):
        trace = run(order, True)
        worst = np.abs(error(trace)[6500:]).max()
        bound = bounds(trace, 6.5)
        assert worst <= bound[order]
        assert worst > bound[order + 1]


def test_with_a_wrong_inertia_the_bound_holds_of_an_error_that_contains_it(make_scenario, two_link):
    """f̃ then holds (B₂,true − B₂) τ as well; the law need not know."""
    wrong = {"kind": "inertia", "masses": [1.5, 1.6], "lengths": [1.0, 1.0]}
    controller = spec(inversion={"effectiveness": wrong})
    events = [{"kind": "freeze", "at": 5.0, "what": "model"}]
    scenario = make_scenario(controller, duration=9.0, events=events)
    trace = simulate(scenario, two_link, watch=False)
    worst = np.abs(error(trace)[6500:]).max()
    assert worst <= bounds(trace, 6.5)[2]


# ---- a wrong B ----


def radius(g: float, order: int) -> float:
    """Spectral radius of the sampled loop in (e, ė, z, LP[z]) where the plant's B₂ is g B₂."""
    e, ed, z, zl = np.eye(4)
    d_hat = (order > 0) * z + (order > 1) * (z - zl)
    wanted = -GAIN * LAM * e - (GAIN + LAM) * ed - d_hat
    qdd = g * wanted
    rows = [
        e + DT * ed + 0.5 * DT**2 * qdd,
        ed + DT * qdd,
        z + SHARE * (qdd - wanted - z),
        zl + SHARE * (z - zl),
    ]
    return float(np.abs(np.linalg.eigvals(np.array(rows))).max())


def window(order: int) -> tuple[float, float]:
    """The least and the largest g that the sampled loop stands."""
    g = np.geomspace(1e-2, 1e2, 4001)
    stands = g[[radius(each, order) < 1.0 for each in g]]
    return stands[0], stands[-1]


@pytest.mark.parametrize("order", [1, 2])
def test_the_effectiveness_may_be_wrong_within_a_window(make_scenario, two_link, order):
    """As the eigenvalues of the sampled loop say; nothing is learned, all masses are g-fold."""
    least, most = window(order)
    settled = {}
    for g in (0.7 * least, 1.8 * least, 0.9 * most, 1.15 * most):
        known = {"kind": "inertia", "masses": [g, 2.3 * g], "lengths": [1.0, 1.0]}
        scenario = make_scenario(
            spec(feed_forward=order, inversion={"effectiveness": known}),
            duration=5.0,
            initial={"q": [0.0, 1.0], "qd": [0.5, 0.0]},
            events=[{"kind": "freeze", "at": 0.0, "what": "model"}],
        )
        trace = simulate(scenario, two_link, watch=False)
        worst = np.abs(error(trace)).max(axis=1)
        settled[g] = trace.info.status == "ok" and worst[4000:].max() < 0.5 * worst[:2000].max()
    assert list(settled.values()) == [radius(g, order) < 1.0 for g in settled]
    assert list(settled.values()) == [False, True, True, False]


def continuous(g: float, order: int) -> np.ndarray:
    """The same loop in continuous time."""
    e, ed, z, zl = np.eye(4)[:, : 2 + order]
    w = -GAIN * LAM * e - (GAIN + LAM) * ed - z - (order > 1) * (z - zl)
    return np.array([ed, g * w, K2 * ((g - 1) * w - z), K2 * (z - zl)][: 2 + order])


@pytest.mark.parametrize("order", [1, 2])
def test_the_window_of_a_wrong_effectiveness_is_the_one_on_the_page(order):
    """docs/theory.md: the polynomials, Hurwitz's least g of each, and the table of limits."""
    c1, c0 = GAIN + LAM, GAIN * LAM
    a = [c1 + K2, c0 + K2 * c1, K2 * c0]
    b = [c1 + 2 * K2, c0 + 2 * K2 * c1 + K2**2, 2 * K2 * c0 + K2**2 * c1, K2**2 * c0]
    bracket = np.array(a if order == 1 else b)
    for g in (0.1, 1.0, 3.0):
        assert np.allclose(np.poly(continuous(g, order)), [1.0, *(g * bracket)], rtol=1e-9)
    limits = a[2] / (a[0] * a[1]), b[2] ** 2 / (b[0] * (b[1] * b[2] - b[0] * b[3]))
    least = limits[order - 1]
    for g, stable in ((0.99 * least, False), (1.01 * least, True), (1e3, True)):
        assert (np.linalg.eigvals(continuous(g, order)).real.max() < 0) == stable
    page = (Path(__file__).parents[1] / "docs" / "theory.md").read_text(encoding="utf-8")
    low, high = window(order)
    assert f"| {order} | {least:.3f} | {low:.3f} | {high:.0f} |" in page


# ---- imperfections ----


def test_a_torque_limit_winds_nothing_up(make_scenario, two_link):
    """Told what acted, it comes out of a limit that acts for long; told its own command, it fails.

    The limit of 60 N·m is little more than the 54.9 that hold the arm still.
    """
    motion = FAST | {"frequency": 1.6, "amplitude": 1.0}
    limits = {"torque_limit": 60.0}
    scenario = make_scenario(spec(), duration=4.0, reference=motion, imperfections=limits)
    told, _ = watched_run(scenario, two_link)
    untold, _ = watched_run(scenario, two_link, told=False)
    assert told.info.status == "ok"
    assert told["saturated"].sum() > 100
    assert not told["saturated"][1000:].any()
    assert np.abs(error(told)[2000:]).max() < 3e-3
    assert untold.info.status == "diverged" or rms(error(untold)[2000:]) > 0.03


@pytest.fixture(scope="module")
def loaded(make_scenario, two_link):
    """A fast motion that meets the same states again, with a payload from 8 of 14 s on."""
    scenario = make_scenario(
        spec(replay={"error": REPLAY_ERROR}),
        duration=14.0,
        reference=FAST,
        events=[PAYLOAD],
        initial={"q": [0.0, 0.5]},
    )
    return watched_run(scenario, two_link)


def test_it_learns_less_as_its_model_gets_better_and_more_after_a_payload(loaded):
    """‖ΔW‖/‖W‖ of the present sample's update, and the rate of the remembered ones."""
    trace, watched = loaded
    spans = [(500, 1500), (7000, 8000), (8050, 8550), (13000, 14000)]
    moved = [trace["update_ratio"][a:b].mean() for a, b in spans]
    early, late, after, end = moved
    assert late < 0.1 * early
    assert after > 10 * late
    assert end < 0.5 * after
    early, late, after, _ = (watched["replay_eta"][a:b].mean() for a, b in spans)
    assert late < 0.7 * early
    assert after > 1.4 * late


def test_the_rate_of_replay_goes_with_its_mean_square_error(loaded):
    _, watched = loaded
    rates = DnnMsoReplay(kind=KIND)
    share = np.minimum(1.0, watched["replay_sq"][:-1] / REPLAY_ERROR**2)
    expected = rates.rate.eta_min + (rates.replay.eta - rates.rate.eta_min) * share
    assert np.allclose(watched["replay_eta"][1:], expected, rtol=1e-12)
    assert share.min() < 0.9


def test_a_payload_replaces_what_is_remembered_of_the_states_met_again(loaded):
    _, watched = loaded
    memory = watched.controller.ticks.parts.law.memory
    size = int(memory.counts[SIZE])
    x, label, stored = memory.x[:size], memory.label[:size], memory.stored[:size]
    newer = stored > memory.counts[CLOCK] * 8.5 / 14.0
    off = {}
    for arm in (ARM, LOADED):
        f = arm.acceleration(x[:, :2], x[:, 2:], np.zeros(2))
        off[arm] = np.abs(label - f).max(axis=1)
    assert 0.7 < newer.mean() < 1.0  # the start is not met again
    assert np.median(off[ARM][~newer]) < 0.1
    assert np.median(off[ARM][newer]) > 1.0


def test_compiled_and_interpreted_run_are_the_same_bit_for_bit(make_scenario, two_link, seen):
    trace, _ = seen
    compiled = simulate(trace.scenario, two_link)
    for name in set(compiled) - CLOCKED:
        assert np.array_equal(trace[name], compiled[name]), name


def fed(n_ticks: int):
    """Inputs of smooth motion near a reference, without a plant."""
    inputs = Inputs.zeros(2)
    rng = np.random.default_rng(3)
    phase = rng.uniform(0, 6, size=(2, 4))
    for t in np.arange(n_ticks) * DT:
        inputs.x_ref[:] = np.sin(t + phase[0])
        inputs.xd_ref[:] = np.cos(t + phase[0])
        inputs.x[:] = inputs.x_ref + 0.1 * np.sin(3 * t + phase[1])
        inputs.tau[:] = rng.normal(size=2)
        yield inputs


@pytest.mark.parametrize("delay", [0.0, 0.005])
def test_a_state_put_back_goes_on_as_it_would_have(make_scenario, two_link, delay):
    controller = spec(known_delay={"sensor": delay, "actuator": delay})
    first = build_controller(make_scenario(controller), two_link)
    second = build_controller(make_scenario(controller, seed=5), two_link)
    commands: list[list[Array]] = [[], []]
    for k, inputs in enumerate(fed(900)):
        if k == 0:
            first.reset(inputs.x)
        if k == 500:
            second.restore(first.state())
        commands[0].append(np.hstack(first.update(inputs)[:5]))
        if k >= 500:
            commands[1].append(np.hstack(second.update(inputs)[:5]))
    assert np.array_equal(commands[0][500:], commands[1])
    one, two = first.state(), second.state()
    assert one.keys() == two.keys()
    for name, values in one.items():
        assert np.array_equal(values, two[name]), name


def test_a_simulation_run_twice_is_the_same_run(make_scenario, two_link):
    simulation = Simulation(make_scenario(spec(), duration=0.3), two_link)
    traces = []
    for _ in range(2):
        recorder = MemoryRecorder(simulation.layout, 300)
        traces.append(recorder.trace(simulation.scenario, simulation.run(recorder)))
    for name in set(traces[0]) - CLOCKED:
        assert np.array_equal(traces[0][name], traces[1][name]), name


@pytest.mark.parametrize("frozen", [MODEL_FROZEN, MODEL_ALONE])
def test_a_frozen_model_stays_and_alone_it_gets_no_help(make_scenario, two_link, frozen):
    controller = build_controller(make_scenario(spec()), two_link)
    for k, inputs in enumerate(fed(400)):
        if k == 0:
            controller.reset(inputs.x)
        if k == 300:
            before = controller.state()
        inputs.frozen[0] = frozen if k >= 300 else 0
        controller.update(inputs)
        d_hat = controller.ticks.parts.law.d_hat
        assert d_hat.any() == (k > 0 and not (k >= 300 and frozen == MODEL_ALONE))
    after = controller.state()
    kept = {name for name in before if name.startswith("memory")} | {"weights", "mean_weights"}
    assert all(np.array_equal(before[name], after[name]) for name in kept)
    assert not np.array_equal(before["x_hat"], after["x_hat"])


@pytest.mark.parametrize("n", [1, 3])
def test_arms_of_other_sizes_are_tracked(n):
    document = json.loads(chain_scenario(n, 4000).model_dump_json()) | {"controller": spec()}
    trace = simulate(Scenario.model_validate(document), chain_arm(n))
    assert trace.info.status == "ok"
    assert rms(error(trace)[2000:]) < 1e-3


def test_it_tracks_without_a_model_of_the_inertia(make_scenario, two_link):
    controller = spec(inversion={"effectiveness": {"kind": "constant", "b": 0.5}})
    trace = simulate(make_scenario(controller, duration=6.0), two_link, watch=False)
    assert rms(error(trace)[3000:]) < 3e-4


# ---- what it has learned ----

FROZEN_AT = 25.0


def frozen_rmse(make_scenario, two_link, **replay) -> float:
    """RMSE of the frozen network alone on a whole period of the motion it learned from."""
    events = [{"kind": "freeze", "at": FROZEN_AT, "what": "all"}]
    scenario = make_scenario(spec(replay=replay), duration=FROZEN_AT + 13.0, events=events)
    trace = simulate(scenario, two_link, watch=False)
    return rms(error(trace)[round(FROZEN_AT / DT) + 400 :])


def test_its_network_alone_holds_the_trajectory_it_has_learned(make_scenario, two_link):
    """Without memory, or with a memory of states undisplaced, the same network does not."""
    frozen = partial(frozen_rmse, make_scenario, two_link)
    alone = frozen()
    assert alone < 1e-3
    assert frozen(position_spread=0.0, velocity_spread=0.0) > 10 * alone
    assert frozen(samples=0) > 30 * alone


REFUSED = [
    ("feed_forward=3", "feed_forward"),
    ("replay.samples=65", "samples"),
    ("replay.capacity=0", "capacity"),
    ("replay.spacing=0", "spacing"),
    ("replay.velocity_spread=-1", "velocity_spread"),
    ("replay.eta=0", "eta"),
    ("rate.low_pass=0", "low_pass"),
    ("rate.average=-0.1", "average"),
    ("known_delay.actuator=2", "actuator"),
    ("known_delay.sensor=.nan", "sensor"),
    ("madam.eta=1e-9", "madam.eta"),
    ("K2=0", "K2"),
    ("K2=[1, 2, 3]", "K2"),
    ("K2=5000", "K2"),
    ("network.outputs=full", "outputs"),
    ("network.backend=torch", "backend"),
    ("observer.torque=commanded", "observer"),
]


@pytest.mark.parametrize(("setting", "culprit"), REFUSED)
def test_settings_that_make_no_sense_are_refused(setting, culprit):
    with pytest.raises(ScenarioError, match=culprit):
        load_scenario("paper", [f"controller.{setting}"], controller=KIND)
