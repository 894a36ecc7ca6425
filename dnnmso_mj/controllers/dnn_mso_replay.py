"""The paper's controller with memory: it learns the plant, and does not merely adapt fast.

    X̂̇ = [q̇; f̂(X)] + B τ + K₂ e_a              (Eq. 5; τ is what acted, the upper rows are known)
    u  = B₂⁻¹ (r₂ + Λ r₁) of f̂(X) + d̂          (Eq. 10)
    W  ← Madam(W, ∂½‖f̂(X_i) − y_i‖²/∂W)         (Alg. 1), of this state and of remembered ones

Since ė_a = f̃ − K₂ e_a, z = K₂ e_a is f̃ through the lag L = K₂/(s + K₂). Three things follow.

*Labels.* The observer's implied dynamics, y = L f̂ + z, are L f exactly, however f̂ was changed by
learning meanwhile; they are remembered at L X, the state through the same lag, unless z is just
turning (‖z − ē‖ ≥ c₀), where the lag falsifies them.

*Feed-forward.* d̂ = z leaves f̃ − d̂ = (1 − L) f̃, and d̂ = 2z − L z, of second order, (1 − L)² f̃.

*Learning rate.* It follows how wrong the model is, by no clock: with ē the low-passed z,

    η = η_min + (η₀ − η_min) min(1, ‖ē‖/c₀),

and that of replay follows the error of replay likewise, squared. The weights that are used are the
mean over the last moments of those that learn, so that learning does not shake the arm.

A known delay between a measurement and the torque that answers it is bridged by prediction: the law
is applied to the state, and the reference, that the torque will meet.

What holds without any assumption on learning, with B exact: s = ė + λe obeys ṡ = −K s + (f̃ − d̂).
If ‖d²f̃/dt²‖ ≤ ρ, then ultimately ‖f̃ − d̂‖ ≤ ρ/K₂² and each |e_i| ≤ ρ/(K₂² K λ); with d̂ = z, and ρ
a bound of ‖df̃/dt‖, |e_i| ≤ ρ/(K₂ K λ). See docs/dnn_mso_replay.md.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from dnnmso_mj import monitors
from dnnmso_mj.compiling import compiled, copy, inner
from dnnmso_mj.controllers import (
    LEARNING,
    MODEL_ALONE,
    Command,
    CompiledTicks,
    Inputs,
    command_of,
)
from dnnmso_mj.inversion import DynamicInversion, build_inversion, invert, solve_spd
from dnnmso_mj.kernel import Net, forward, output_at, prediction
from dnnmso_mj.kernel import learn as learn_once
from dnnmso_mj.learner import KernelLearner
from dnnmso_mj.memory import (
    SIZE,
    Memory,
    build_memory,
    memory_state,
    recall,
    remember,
    restore_memory,
)
from dnnmso_mj.monitors import Watch
from dnnmso_mj.network import initial_weights, network_shape
from dnnmso_mj.observer import StateObserver, advance, build_observer, compare, start
from dnnmso_mj.plant import NominalModel, inertia
from dnnmso_mj.prediction import Predictor, build_predictor, predict, report
from dnnmso_mj.scenario import DnnMsoReplay, Observer
from dnnmso_mj.tick import closed_loop

Array = np.ndarray

ETA = 0  # the slot of `Net.settings`
REPLAY_TIME = 0.1  # s, over which the error of replay is averaged


class Law(NamedTuple):
    """The controller's arrays but for its command and its network."""

    inversion: DynamicInversion
    observer: StateObserver
    memory: Memory
    predictor: Predictor
    f_used: Array  # (2n,) f̂ + d̂, what the inversion takes for f
    acted: Array  # (n,) N·m, in the period before the measurement
    z: Array  # (n,) rad/s², K₂ e_a
    d_hat: Array  # (n,) rad/s²
    z_lagged: Array  # (n,) rad/s², K₂ e_a through the observer's lag once more
    low_passed: Array  # (n,) ē
    f_lagged: Array  # (n,) rad/s², f̂ through the observer's lag
    x_lagged: Array  # (2n,) the state through the same lag
    label: Array  # (n,) rad/s²
    M: Array  # (n, n) B₂⁻¹ at the last measured state
    free: Array  # (n,) scratch
    L: Array  # (n, n) scratch
    ticks: Array  # (1,) int64 done so far
    decay: float  # of the low pass in a tick
    error: float  # c₀, rad/s²
    eta_0: float  # η of an error from c₀ on
    eta_min: float  # η of none
    eta_replay: float  # that of replay, from replay_error on
    replay_error: float  # rad/s²
    replay_sq: Array  # (1,) low-passed ‖f̂(X_i) − y_i‖² of what was replayed
    replay_share: float  # of one sample in it
    average: float  # share of the newest weights in their mean
    samples: int  # replayed in a tick
    every: int  # ticks between two states that are remembered
    feed_forward: bool
    lead: float  # 1 for the second order: how much of z − L z is added to z


class Parts(NamedTuple):
    """The arrays of the compiled controller."""

    law: Law
    command: Command
    net: Net  # that learns
    mean: Net  # with the mean of its weights over the last time, which is used
    watch: Watch


def build_law(spec: DnnMsoReplay, n_joints: int, dt: float, nominal: NominalModel) -> Law:
    """The law of a scenario, with an empty memory; arguments as of the controller."""
    n, replay, rate = n_joints, spec.replay, spec.rate
    acted, z, d_hat, z_lagged, low_passed, f_lagged, label, free = np.zeros((8, n))
    f_used, x_lagged = np.zeros((2, 2 * n))
    spreads = (replay.position_spread, replay.velocity_spread)
    return Law(
        inversion=build_inversion(spec.inversion, n, nominal.view),
        observer=build_observer(Observer(K2=spec.K2), 2 * n, dt),
        memory=build_memory(replay.capacity, n, replay.spacing, *spreads),
        predictor=build_predictor(spec.known_delay, n, dt),
        f_used=f_used,
        acted=acted,
        z=z,
        d_hat=d_hat,
        z_lagged=z_lagged,
        low_passed=low_passed,
        f_lagged=f_lagged,
        x_lagged=x_lagged,
        label=label,
        M=np.eye(n),
        free=free,
        L=np.zeros((n, n)),
        ticks=np.zeros(1, np.int64),
        decay=math.exp(-dt / rate.low_pass),
        error=rate.error,
        eta_0=spec.madam.eta,
        eta_min=rate.eta_min,
        eta_replay=replay.eta,
        replay_error=replay.error,
        replay_sq=np.zeros(1),
        replay_share=-math.expm1(-dt / REPLAY_TIME / max(1, replay.samples)),
        average=-math.expm1(-dt / rate.average),
        samples=replay.samples,
        every=max(1, round(replay.every / dt)),
        feed_forward=spec.feed_forward > 0,
        lead=1.0 if spec.feed_forward == 2 else 0.0,
    )


class DnnMsoReplayController:
    """DNN-MSO with experience replay.

    Args:
        spec: settings of the scenario.
        n_joints: n.
        dt: control period (s).
        seed: of the initial weights.
        nominal: the controller's own model of the robot, read for B alone.
        watch: whether the monitors are kept.
    """

    def __init__(
        self,
        spec: DnnMsoReplay,
        n_joints: int,
        dt: float,
        seed: int,
        nominal: NominalModel,
        *,
        watch: bool = True,
    ) -> None:
        n = n_joints
        self._nominal = nominal  # keeps alive what compiled code knows by address
        network = spec.network.as_network()
        shape = network_shape(network, 2 * n, n)
        weights = initial_weights(shape, network, np.random.default_rng(seed))
        weights = weights.astype(network.precision)
        self.learner = KernelLearner(shape, weights, spec.madam, watch=watch)
        self.n_layers = shape.n_layers
        self._law = build_law(spec, n, dt, nominal)
        self._command = command_of(
            self._law.inversion, self._law.observer.e_obs, self.learner.monitors
        )
        net = self.learner.net
        self._mean = net._replace(w=net.w.copy(), acts=np.zeros_like(net.acts))
        parts = Parts(self._law, self._command, net, self._mean, self.learner.watch)
        self.ticks = CompiledTicks(run_ticks, parts, DnnMsoReplayController.update)

    def reset(self, x: Array) -> None:
        law = self._law
        start(law.observer, x)
        for array in (law.ticks, law.z_lagged, law.low_passed, law.predictor.tau):
            array[:] = 0

    def update(self, inputs: Inputs) -> Command:
        update(self.ticks.parts, inputs)
        return self._command

    def dynamics(self, x: Array) -> Array:
        forward(self._mean, x)
        out = output_at(self._mean)
        return self._mean.acts[out : out + x.size // 2].astype(float)

    def state(self) -> dict[str, Array]:
        law = self._law
        return {
            "x_hat": law.observer.x_hat.copy(),
            "e_obs": law.observer.e_obs.copy(),
            "f_hat": self._command.f_hat.copy(),
            "z_lagged": law.z_lagged.copy(),
            "low_passed": law.low_passed.copy(),
            "M": law.M.copy(),
            "ticks": law.ticks.copy(),
            "torques": law.predictor.tau.copy(),
            "mean_weights": self._mean.w.copy(),
            "replay_sq": law.replay_sq.copy(),
            "f_lagged": law.f_lagged.copy(),
            "x_lagged": law.x_lagged.copy(),
            **memory_state(law.memory),
            **self.learner.state(),
        }

    def restore(self, state: Mapping[str, Array]) -> None:
        law = self._law
        law.observer.x_hat[:], law.observer.e_obs[:] = state["x_hat"], state["e_obs"]
        self._command.f_hat[:] = state["f_hat"]
        law.z_lagged[:] = state["z_lagged"]
        law.low_passed[:], law.M[:] = state["low_passed"], state["M"]
        law.ticks[:], law.predictor.tau[:] = state["ticks"], state["torques"]
        law.replay_sq[:] = state["replay_sq"]
        law.f_lagged[:], law.x_lagged[:] = state["f_lagged"], state["x_lagged"]
        self._mean.w[:] = state["mean_weights"]
        restore_memory(law.memory, state)
        self.learner.restore(state)


@inner
def observe(law: Law, command: Command, inputs: Inputs) -> None:
    """X̂ over the period before the measurement, with the torque that acted in it; then e_a, d̂."""
    observer, n = law.observer, law.d_hat.size
    report(law.predictor.tau, law.predictor.sensor, inputs.tau, law.acted)
    if law.ticks[0] > 0:
        solve_spd(law.M, law.acted, law.free, law.L)
        for i in range(n):
            law.f_used[i], law.f_used[n + i] = 0.0, law.free[i]
        advance(observer, command.f_hat, law.f_used)
    compare(observer, inputs.x)
    copy(observer.x_hat, command.x_hat)
    for i in range(n):
        z = observer.gain[n + i] * observer.e_obs[n + i]
        law.d_hat[i] = z + law.lead * (z - law.z_lagged[i])
        law.z_lagged[i] += observer.dt * observer.gain[n + i] * (z - law.z_lagged[i])
        law.low_passed[i] = law.decay * law.low_passed[i] + (1.0 - law.decay) * z
        law.z[i] = z


@inner
def lag(law: Law, command: Command, x: Array) -> None:
    """f̂ and X through 1/(1 + s/K₂), in the observer's own Euler steps."""
    n = law.d_hat.size
    for i in range(n):
        share = law.observer.dt * law.observer.gain[n + i]
        law.f_lagged[i] += share * (command.f_hat[n + i] - law.f_lagged[i])
        law.x_lagged[i] += share * (x[i] - law.x_lagged[i])
        law.x_lagged[n + i] += share * (x[n + i] - law.x_lagged[n + i])


@inner
def act(parts: Parts, inputs: Inputs) -> None:
    """u at the measured state, or at the predicted one where a delay is known."""
    law, net, n = parts.law, parts.mean, parts.law.d_hat.size
    ahead, output = inputs.x, parts.command.f_hat[n:]
    if not law.feed_forward or inputs.frozen[0] == MODEL_ALONE:
        for i in range(n):
            law.d_hat[i] = 0.0
    if len(law.predictor.tau) > 1:
        predict(law.predictor, law.inversion, net, inputs.x, law.d_hat)
        ahead = law.predictor.x
        forward(net, ahead)
        copy(prediction(net), law.free)
        output = law.free
    for i in range(n):
        law.f_used[i], law.f_used[n + i] = ahead[n + i], output[i] + law.d_hat[i]
    invert(law.inversion, ahead, inputs.x_ref, inputs.xd_ref, law.f_used)
    copy(law.inversion.tau, law.predictor.tau[-1])


@inner
def keep_inertia(law: Law, q: Array) -> None:
    """B₂⁻¹ at the measured q, for the observer's next step."""
    n = law.d_hat.size
    if len(law.predictor.tau) > 1 and not law.inversion.constant:
        inertia(law.inversion.nominal, q)
        for i in range(n):
            copy(law.inversion.nominal.M[i], law.M[i])
    else:
        for i in range(n):
            copy(law.inversion.B2_inv[i], law.M[i])


@inner
def learn(parts: Parts, inputs: Inputs) -> None:
    """From the present state, which the network has just seen, and from remembered ones."""
    law, net, n = parts.law, parts.net, parts.law.d_hat.size
    memory = law.memory
    wrong = turning = 0.0
    for i in range(n):
        wrong += law.low_passed[i] ** 2
        turning += (law.z[i] - law.low_passed[i]) ** 2
    share = min(1.0, math.sqrt(wrong) / law.error)
    eta = law.eta_min + (law.eta_0 - law.eta_min) * share
    delta = output_at(net)
    forward(net, inputs.x)
    output = prediction(net)
    for i in range(n):
        net.deltas[delta + i] = output[i] - parts.command.f_hat[n + i] - law.z[i]
        law.label[i] = law.f_lagged[i] + law.z[i]
    net.settings[ETA] = eta
    monitors.learn(net, parts.watch, parts.command.monitors)
    if law.ticks[0] % law.every == 0 and turning < law.error**2:
        remember(memory, law.x_lagged, law.label)
    share = min(1.0, law.replay_sq[0] / law.replay_error**2)
    net.settings[ETA] = law.eta_min + (law.eta_replay - law.eta_min) * share
    if memory.counts[SIZE] > 0:
        for _ in range(law.samples):
            entry = recall(memory)
            forward(net, memory.recalled)
            output = prediction(net)
            wrong = 0.0
            for i in range(n):
                net.deltas[delta + i] = output[i] - memory.label[entry, i]
                wrong += net.deltas[delta + i] ** 2
            law.replay_sq[0] += law.replay_share * (wrong - law.replay_sq[0])
            learn_once(net)
    _average(net.w, parts.mean.w, law.average)


@compiled
def _average(w: Array, mean: Array, share: float) -> None:
    """mean ← mean + share (w − mean)."""
    part = mean.dtype.type(share)
    for i in range(w.size):
        mean[i] += part * (w[i] - mean[i])


@inner
def update(parts: Parts, inputs: Inputs) -> None:
    """One tick of the law above."""
    law, command, n = parts.law, parts.command, parts.law.d_hat.size
    observe(law, command, inputs)
    forward(parts.mean, inputs.x)
    output = prediction(parts.mean)
    for i in range(n):
        command.f_hat[i], command.f_hat[n + i] = inputs.x[n + i], output[i]
    if law.ticks[0] == 0:
        copy(inputs.x, law.x_lagged)
        copy(command.f_hat[n:], law.f_lagged)
    if inputs.frozen[0] == LEARNING:
        learn(parts, inputs)
    lag(law, command, inputs.x)
    act(parts, inputs)
    keep_inertia(law, inputs.x[:n])
    law.ticks[0] += 1


run_ticks = closed_loop(update)
