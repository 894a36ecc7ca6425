"""Prediction over known delays: the integration, and which torque acts when."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from dnnmso_mj.dynamics import TwoLink
from dnnmso_mj.inversion import build_inversion
from dnnmso_mj.kernel import build_net
from dnnmso_mj.memory_recorder import MemoryRecorder
from dnnmso_mj.network import initial_weights, network_shape
from dnnmso_mj.plant import NominalModel
from dnnmso_mj.prediction import LONGEST, build_predictor, predict, report
from dnnmso_mj.scenario import KnownDelay, Madam, Network
from dnnmso_mj.scenario.inversion import Inversion
from dnnmso_mj.simulation import Simulation, simulate
from tests.kernel_loss import output

Array = np.ndarray
ARM = TwoLink((1.0, 2.3), (1.0, 1.0))
DT = 0.001
X0 = np.array([0.3, -0.4, 0.7, -1.1])
D_HAT = np.array([0.8, -1.7])  # rad/s²
MODELS = pytest.mark.parametrize("b", [None, 0.7])


class Known(NamedTuple):
    """A model that prediction knows: a network's drift, and M(q)⁻¹ or b·I."""

    net: object
    inversion: object
    b: float | None
    nominal: object  # kept for the inversion's sake

    def acceleration(self, x: Array, tau: Array) -> Array:
        effect = np.linalg.solve(ARM.inertia(x[:2]), tau) if self.b is None else self.b * tau
        return output(self.net, x) + D_HAT + effect


@pytest.fixture
def known(make_scenario, two_link):
    def build(b: float | None) -> Known:
        believed = {"kind": "constant", "b": b} if b else {"kind": "inertia"}
        spec = Inversion.model_validate({"effectiveness": believed})
        nominal = NominalModel(make_scenario(), two_link)
        network = Network(hidden=(16, 16), precision="float64", output_scale=3.0)
        shape = network_shape(network, 4, 2)
        weights = initial_weights(shape, network, np.random.default_rng(5))
        net = build_net(shape, weights, Madam())
        return Known(net, build_inversion(spec, 2, nominal.view), b, nominal)

    return build


def predicted(known: Known, tau: Array, dt: float) -> Array:
    """The state after the periods of torques tau (D, 2)."""
    spec = KnownDelay(actuator=len(tau) * dt)
    predictor = build_predictor(spec, 2, dt)
    predictor.tau[:-1] = tau
    predictor.tau[-1] = np.nan  # the torque that is still to be chosen plays no part
    predict(predictor, known.inversion, known.net, X0, D_HAT)
    return predictor.x.copy()


def integrated(known: Known, tau: Array, dt: float) -> Array:
    """The same, exact to 1e-11."""

    def flow(t: float, x: Array, torque: Array) -> Array:
        return np.append(x[2:], known.acceleration(x, torque))

    x, exact = X0, {"method": "DOP853", "rtol": 1e-11, "atol": 1e-12}
    for torque in tau:
        x = solve_ivp(flow, (0.0, dt), x, args=(torque,), **exact).y[:, -1]
    return x


def torques(count: int, dt: float) -> Array:
    """Held over each period, about what the arm's weight asks for."""
    t = dt * np.arange(count)[:, None]
    return np.array([40.0, 15.0]) + np.array([8.0, -6.0]) * np.sin(40.0 * t + [0.0, 1.0])


@MODELS
def test_with_the_true_model_it_ends_at_the_state_that_comes(known, b):
    model = known(b)
    tau = torques(20, 0.001)
    came = integrated(model, tau, 0.001)
    error = np.abs(predicted(model, tau, 0.001) - came)
    assert np.abs(came - X0).max() > 0.05
    assert error.max() < 0.01 * np.abs(came - X0).max()


@MODELS
def test_its_error_is_of_first_order_in_the_step(known, b):
    model, errors = known(b), []
    for dt in (0.008, 0.004, 0.002):  # all at LONGEST or above it, so a step is a period
        assert dt >= LONGEST
        tau = np.tile([45.0, 12.0], (round(0.048 / dt), 1))
        errors.append(np.abs(predicted(model, tau, dt) - integrated(model, tau, dt)).max())
    ratios = np.array(errors[:-1]) / errors[1:]
    assert np.all(np.abs(ratios - 2.0) < 0.3), ratios


def test_periods_shorter_than_its_step_are_taken_together_by_their_mean(known):
    model, dt = known(0.7), LONGEST / 4
    assert build_predictor(KnownDelay(), 2, dt).stride == 4
    tau = torques(20, dt)
    means = tau.reshape(5, 4, 2).mean(axis=1)
    assert predicted(model, tau, dt) == pytest.approx(predicted(model, means, LONGEST), abs=1e-14)
    odd = torques(21, dt)  # the last step has one period alone
    came = integrated(model, odd, dt)
    assert np.abs(predicted(model, odd, dt) - came).max() < 0.01 * np.abs(came - X0).max()


def test_one_step_is_its_formula(known):
    model, tau, h = known(None), np.array([[50.0, 3.0]]), 0.001
    qdd = model.acceleration(X0, tau[0])
    expected = np.append(X0[:2] + h * X0[2:] + 0.5 * h**2 * qdd, X0[2:] + h * qdd)
    assert predicted(model, tau, h) == pytest.approx(expected, rel=1e-14)


def test_without_a_delay_nothing_is_predicted(known):
    assert np.array_equal(predicted(known(None), np.zeros((0, 2)), 0.001), X0)


@pytest.mark.parametrize(("sensor", "actuator"), [(0, 0), (0, 3), (2, 0), (2, 3), (1, 1)])
def test_a_queue_holds_what_acts_from_the_measurement_to_the_command(sensor, actuator):
    """Tick k's command is k; it acts in period k + d_a, where the drives may make another of it."""
    predictor = build_predictor(KnownDelay(sensor=sensor * 1e-3, actuator=actuator * 1e-3), 1, 1e-3)
    past = np.zeros(1)

    def acts(period: int) -> float:
        """What comes of the command that acts in a period; none before the first."""
        return float(period - actuator) + 0.25 if period >= actuator else 0.0

    for k in range(1, 30):
        report(predictor.tau, sensor, np.array([acts(k - 1)]), past)
        predictor.tau[-1] = k
        if k > sensor + actuator + 1:
            assert past[0] == acts(k - sensor - 1)
            queue = [acts(period) for period in range(k - sensor, k)]  # reported
            queue += [float(period - actuator) for period in range(k, k + actuator + 1)]  # to come
            assert predictor.tau[:, 0].tolist() == queue


DELAYS = pytest.mark.parametrize(("sensor", "actuator"), [(0.0, 0.01), (0.006, 0.0), (0.004, 0.01)])


class Watched:
    """A controller whose predictor is written down each tick."""

    def __init__(self, controller) -> None:
        self._controller = controller
        self.n_layers = controller.n_layers
        self.read: list[Array] = []
        self.ahead: list[Array] = []
        self.queue: list[Array] = []
        self.modelled: list[Array] = []

    def __getattr__(self, name):
        return getattr(self._controller, name)

    def update(self, inputs):
        command = self._controller.update(inputs)
        predictor = self._controller.ticks.parts.law.predictor
        self.read.append(inputs.x.copy())
        self.ahead.append(predictor.x.copy())
        self.queue.append(predictor.tau.copy())
        if len(self.read) % 400 == 0:
            self.modelled.append(self._by_its_own_model(inputs.x, predictor.tau))
        return command

    def _by_its_own_model(self, x: Array, tau: Array) -> Array:
        """The state ahead by what `dynamics` and d̂ say now, two periods at once."""
        x, d_hat = x.copy(), self._controller.ticks.parts.law.d_hat
        pairs = tau[:-1].reshape(-1, 2, 2).mean(axis=1)
        for torque in pairs:
            drift = self._controller.dynamics(x) + d_hat
            qdd = drift + np.linalg.solve(ARM.inertia(x[:2]), torque)
            x += np.concatenate([LONGEST * x[2:] + 0.5 * LONGEST**2 * qdd, LONGEST * qdd])
        return x


@pytest.fixture(scope="module")
def delayed(make_scenario, two_link):
    """A run with both delays, and what the controller knew in it."""
    done: dict[tuple[float, float], tuple[object, Watched]] = {}

    def run(sensor: float, actuator: float):
        if (sensor, actuator) not in done:
            controller = {
                "kind": "dnn_mso_replay",
                "known_delay": {"sensor": sensor, "actuator": actuator},
            }
            scenario = make_scenario(
                controller,
                duration=3.0,
                imperfections={"sensor_delay": sensor, "actuator_delay": actuator},
            )
            simulation = Simulation(scenario, two_link)
            simulation.controller = watched = Watched(simulation.controller)
            recorder = MemoryRecorder(simulation.layout, scenario.n_ticks)
            trace = recorder.trace(scenario, simulation.run(recorder))
            assert trace.info.status == "ok"
            done[sensor, actuator] = trace, watched
        return done[sensor, actuator]

    return run


@DELAYS
def test_in_a_run_the_queue_is_what_acted(delayed, sensor, actuator):
    trace, watched = delayed(sensor, actuator)
    late, ahead = round(sensor * 1000), round(actuator * 1000)
    for k in range(100, 2900, 100):
        acted = trace["tau"][k - late : k + ahead + 1]
        assert np.array_equal(watched.queue[k], acted)


def from_there(x: Array, tau: Array) -> Array:
    """The arm's state after periods of torques tau (D, 2) from x, by its formula."""

    def flow(t: float, x: Array, torque: Array) -> Array:
        return np.append(x[2:], ARM.acceleration(x[:2], x[2:], torque))

    for torque in tau:
        x = solve_ivp(flow, (0.0, DT), x, args=(torque,), rtol=1e-9, atol=1e-11).y[:, -1]
    return x


@DELAYS
def test_with_the_exact_model_the_queue_leads_to_the_state_that_came(delayed, sensor, actuator):
    """And a queue shifted by a tick, a wrong delay, leads elsewhere."""
    trace, watched = delayed(sensor, actuator)
    ahead = round(actuator * 1000)
    x_true = np.hstack([trace["q"], trace["qd"]])
    for k in range(100, 2900, 400):
        came = x_true[k + ahead]
        right = from_there(watched.read[k], watched.queue[k][:-1])
        short = from_there(watched.read[k], watched.queue[k][:-2])
        assert np.abs(right - came).max() < 1e-6
        assert np.abs(short - came).max() > 1e-4


@DELAYS
def test_in_a_run_it_is_the_present_model_that_predicts(delayed, sensor, actuator):
    _, watched = delayed(sensor, actuator)
    ahead = np.array(watched.ahead)[399::400]
    assert np.allclose(ahead, watched.modelled, rtol=0.0, atol=1e-6)
    assert np.abs(ahead - np.array(watched.read)[399::400]).max() > 1e-3


def test_a_model_that_knows_the_plant_takes_a_known_delay_away(make_scenario, two_link):
    """After a period of the motion; one that does not know of the delay stays as it was."""

    def rmse(known: float, first: float, last: float) -> float:
        controller = {"kind": "dnn_mso_replay", "known_delay": {"actuator": known}}
        late = {"actuator_delay": 0.02, "torque_limit": 120.0}
        trace = simulate(make_scenario(controller, duration=last, imperfections=late), two_link)
        error = (trace["q"] - trace["q_ref"])[round(first / DT) :]
        return float(np.sqrt(np.mean(error**2)))

    right, wrong = rmse(0.02, 16.5, 18.5), rmse(0.0, 16.5, 18.5)
    assert right < 3e-4
    assert wrong > 8 * right
