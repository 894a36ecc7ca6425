"""What a row says, each number against its definition."""

from __future__ import annotations

import numpy as np
import pytest

from dnnmso_mj.controllers import Inputs
from dnnmso_mj.dynamics import TwoLink
from dnnmso_mj.learner import KernelLearner, build_learner
from dnnmso_mj.metrics import compute_metrics
from dnnmso_mj.monitors import WATCH_EVERY
from dnnmso_mj.network import INIT_SCALE, Shape, initial_weights, network_shape
from dnnmso_mj.scenario import Inversion, Madam, Network
from dnnmso_mj.simulation import Simulation, simulate
from dnnmso_mj.theory import begin_period, build_bounds, end_period, start_bounds


def track_error(trace):
    return np.concatenate([trace["q"] - trace["q_ref"], trace["qd"] - trace["qd_ref"]], axis=1)


def test_lyapunov_function_is_the_squared_tracking_error(make_scenario):
    trace = simulate(make_scenario(duration=0.2))
    assert np.allclose(trace["lyapunov"], (track_error(trace) ** 2).sum(axis=1), rtol=1e-12)


def test_papers_bound_starts_at_the_error_and_follows_its_equation(make_scenario):
    trace = simulate(make_scenario({"kind": "no_network"}, duration=0.2))
    bound, K, dt = trace["ultimate_bound_paper"], 7.5, 1e-3
    assert bound[0] == pytest.approx(np.linalg.norm(track_error(trace)[0]), rel=1e-12)
    f_err = np.linalg.norm(trace["f_true"] - trace["f_hat"], axis=1)
    expected = np.exp(-K * dt) * bound[:-1] + (1 - np.exp(-K * dt)) / K * f_err[:-1]
    assert np.allclose(bound[1:], expected, rtol=1e-9)


def test_papers_bound_uses_the_smallest_eigenvalue_of_k():
    bounds = build_bounds(Inversion(K=[1.0, 9.0]), 1, 0.1, first_order=False)
    start_bounds(bounds, np.array([3.0, 4.0]))
    begin_period(bounds, np.zeros(2), np.zeros(2), np.zeros(1), np.zeros(1))
    end_period(bounds, np.zeros(2), np.zeros(1), np.zeros(1))
    assert bounds.paper[0] == pytest.approx(5.0 * np.exp(-0.1))


def test_bound_holds_where_the_torque_saturates_and_the_arm_falls(make_scenario):
    limits = {"torque_limit": [40.0, 30.0]}
    trace = simulate(make_scenario(duration=3.0, imperfections=limits))
    metrics = compute_metrics(trace)
    assert trace["saturated"].any()
    assert metrics["rmse"] > 0.2
    assert metrics["bound_violations"] == 0


def test_gradient_change_is_measured_every_tenth_tick_and_held_between(make_scenario):
    change = simulate(make_scenario(duration=0.1))["gradient_change"]
    sampled = change[::WATCH_EVERY]
    assert np.array_equal(np.repeat(sampled, WATCH_EVERY, axis=0), change)
    assert np.all(sampled[1:] > 0)
    assert len(np.unique(sampled[:, 0])) == len(sampled)


def test_clipped_is_set_where_an_update_is_clamped(make_scenario):
    def clipped(**madam):
        return simulate(make_scenario({"kind": "dnn_mso", "madam": madam}, duration=0.1))["clipped"]

    assert not clipped().any()
    assert clipped(eta_max=0.002).any()
    assert clipped(sigma_max=1.0).any()


def test_kinematic_outputs_are_the_measured_velocity(make_scenario):
    controller = {"kind": "dnn_mso", "network": {"outputs": "kinematic"}}
    trace = simulate(make_scenario(controller, duration=0.1))
    assert np.array_equal(trace["f_hat"][:, :2], trace["qd"])
    assert not np.array_equal(simulate(make_scenario(duration=0.1))["f_hat"][:, :2], trace["qd"])


def test_an_angle_out_of_this_world_ends_the_run(make_scenario):
    trace = simulate(make_scenario(initial={"q": [-2000.0, 0.0]}))
    assert trace.info.status == "diverged"
    assert trace.info.reason.startswith("|q| = 2000, above 1000")


def test_classical_mso_takes_one_step_of_eq_4(make_scenario, two_link):
    """Observer with f(X̂), inversion with f(X), and a gradient of −Bᵀ e_a."""
    masses, dt, K, lam, K2 = (0.8, 1.6), 1e-3, 7.5, 7.5, 30.0
    nominal = {"effectiveness": {"kind": "inertia", "masses": list(masses)}}
    scenario = make_scenario({"kind": "classical_mso", "inversion": nominal}, seed=4)
    controller = Simulation(scenario, two_link).controller
    twin = build_learner(Network(), Madam(), 4, 2, seed=4)
    arm = TwoLink(masses, (1.0, 1.0))

    def known(x):
        return np.concatenate([x[2:], arm.acceleration(x[:2], x[2:], np.zeros(2))])

    x_hat, x, x_ref, xd_ref = np.random.default_rng(1).normal(size=(4, 4))
    controller.reset(x_hat)
    command = controller.update(Inputs.zeros(2)._replace(x=x, x_ref=x_ref, xd_ref=xd_ref))
    B2 = np.linalg.inv(arm.inertia(x[:2]))
    d_hat, e_obs = twin.predict(x), x - x_hat
    learned = np.concatenate([np.zeros(2), B2 @ d_hat])
    f_hat = known(x) + learned
    r = xd_ref - f_hat - K * (x - x_ref)
    tau = np.linalg.solve(B2, r[2:] + lam * r[:2])
    assert np.allclose(command.f_hat, f_hat, rtol=1e-9)
    assert np.allclose(command.tau, tau, rtol=1e-9)
    Bu = np.concatenate([np.zeros(2), B2 @ tau])
    moved = x_hat + dt * (known(x_hat) + learned + Bu + K2 * e_obs)
    assert np.allclose(controller.state()["x_hat"], moved, rtol=1e-9)
    twin.learn(-B2.T @ e_obs[2:])
    assert np.allclose(controller.state()["weights"], twin.state()["weights"], rtol=1e-10)


def test_output_scale_shrinks_the_last_layer_alone():
    def layers(scale):
        spec = Network(hidden=(5, 5), output_scale=scale)
        shape = network_shape(spec, 4, 4)
        return shape.split(initial_weights(shape, spec, np.random.default_rng(0)))

    for k, (full, scaled) in enumerate(zip(layers(1.0), layers(0.1), strict=True)):
        assert np.allclose(scaled, full * (0.1 if k == 2 else 1.0), rtol=1e-12)


def test_initial_scales_are_those_of_the_cited_papers():
    assert {"sigmoid": 3.6, "tanh": 1.0, "relu": pytest.approx(2**0.5)} == INIT_SCALE


@pytest.mark.parametrize(("w", "clipped"), [(0.5, False), (0.9999, True)])
def test_a_weight_held_at_its_largest_counts_as_clipped(w, clipped):
    shape = Shape((1, 1), bias=False, activation="sigmoid")
    learner = KernelLearner(shape, np.array([w]), Madam(sigma_max=1.0))
    learner.predict(np.ones(1))
    learner.learn(-np.ones(1))
    assert bool(learner.monitors.clipped[0]) is clipped
    assert learner.state()["weights"][0] <= 1.0


def test_a_torque_that_mujoco_would_drop_ends_the_run(make_scenario):
    trace = simulate(make_scenario(plant={"masses": [1e9, 1e9]}, duration=0.01))
    assert trace.info.status == "diverged"
    assert trace.info.reason.startswith("tau = ")


def test_true_dynamics_of_the_classical_mso_hold_where_the_torque_saturates(make_scenario):
    nominal = {"effectiveness": {"kind": "inertia", "masses": [0.8, 1.6]}}
    limits = {"torque_limit": [60.0, 30.0]}
    controller = {"kind": "classical_mso", "inversion": nominal}
    trace = simulate(make_scenario(controller, duration=1.0, imperfections=limits))
    q, tau = trace["q"], trace["tau"]
    qdd = TwoLink((1.0, 2.3), (1.0, 1.0)).acceleration(q, trace["qd"], tau)
    M = TwoLink((0.8, 1.6), (1.0, 1.0)).inertia(q)
    expected = qdd - np.linalg.solve(M, tau[..., None])[..., 0]
    assert trace["saturated"].any()
    assert np.allclose(trace["f_true"][:, 2:], expected, rtol=1e-8, atol=1e-8)
