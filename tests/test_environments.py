"""The environments: the same trajectory as `simulate`, and what their ecosystems ask of them."""

from __future__ import annotations

import ctypes.util
import os
import pickle
import subprocess
import sys
import unittest
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
from dm_env import StepType
from dm_env.test_utils import EnvironmentTestMixin
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env

from dnnmso_mj.controllers import Inputs, build_controller
from dnnmso_mj.environments import dm
from dnnmso_mj.environments.gym import ID, TrackingEnv
from dnnmso_mj.errors import DnnmsoError, ScenarioError
from dnnmso_mj.loading import load_scenario
from dnnmso_mj.metrics import compute_metrics
from dnnmso_mj.paths import find_model
from dnnmso_mj.plant import Mjcf
from dnnmso_mj.simulation import simulate
from dnnmso_mj.trace import Trace

Array = np.ndarray
Law = Callable[[Array], Array]

SCALE = 1024.0  # N·m, a power of two: no torque is rounded on its way
SETS = (
    "duration=1",
    "imperfections={sensor_delay: 0.0017, jitter: 0.001, position_noise: 1.0e-4, torque_rate: 9000,"
    " velocity_noise: 1.0e-3, actuator_lag: 0.004, actuator_delay: 0.0023, torque_limit: 90,"
    " friction: {viscous: 0.1, coulomb: 0.1, breakaway: 0.2}}",
    "events=[{kind: payload, at: 0.1, mass: 0.5},"
    " {kind: push, at: 0.333, duration: 0.1, torque: [5.0, 0.0]}]",
)
SHORT = ("duration=0.02",)
QUIET = pytest.mark.filterwarnings("ignore::dnnmso_mj.loading.ScenarioWarning")


@pytest.fixture(scope="module")
def pd_run() -> Trace:
    """A run of kind pd that meets noise, delay, friction, a payload, a push and its limit."""
    return simulate(load_scenario("paper", [*SETS, "seed=7"], controller="pd"))


def pd_law() -> Law:
    """Actions of the very controller, told by the observation."""
    scenario = load_scenario("paper", controller="pd")
    controller = build_controller(scenario, Mjcf.read(find_model("two_link")))

    def act(observation: Array) -> Array:
        x, x_ref, xd_ref = observation[:4], observation[4:8], observation[6:10]
        inputs = Inputs(x, observation[10:], x_ref, xd_ref, np.zeros(1, np.int64))
        return controller.update(inputs).tau / SCALE

    return act


def play(env: TrackingEnv, law: Law, **reset: Any) -> tuple[list[float], dict[str, Any]]:
    """One episode's rewards, and what is told in the end."""
    observation, _ = env.reset(**reset)
    rewards = []
    while True:
        observation, reward, terminated, truncated, info = env.step(law(observation))
        rewards.append(reward)
        if terminated or truncated:
            return rewards, info


def check_same(one: Trace, other: Trace) -> None:
    assert len(one) == len(other)
    for name in set(one) - {"compute_us"}:
        assert np.array_equal(one[name], other[name], equal_nan=True), name
    assert one.events == other.events
    assert (one.info.status, one.info.reason) == (other.info.status, other.info.reason)


# The same trajectory


@QUIET
def test_gymnasium_s_episode_is_the_run_of_the_same_torques_bit_for_bit(pd_run):
    env = TrackingEnv("paper", SETS, torque_scale=SCALE)
    for _ in range(2):  # the second one finds the world as the first one left it
        _, info = play(env, pd_law(), seed=7)
        check_same(env.trace(), pd_run)
    assert pd_run["saturated"].any()
    assert {event.level for event in pd_run.events} == {"info", "warning"}
    expected = compute_metrics(pd_run)
    same = set(expected) - {"compute_us_p50", "compute_us_p999"}
    assert {name: info["metrics"][name] for name in same} == {n: expected[n] for n in same}
    assert (info["status"], info["error"], info["t"]) == ("ok", "", 1.0)


@QUIET
def test_dm_control_s_episode_is_the_run_of_the_same_torques_bit_for_bit(pd_run):
    env = dm.load("paper", (*SETS, "seed=7"), torque_scale=SCALE)
    law, step = pd_law(), env.reset()
    while not step.last():
        step = env.step(law(np.concatenate(list(step.observation.values()))))
    assert (step.discount, env.physics.time()) == (1.0, 1.0)
    check_same(env.task.trace(), pd_run)
    assert env.task.metrics["rmse"] == compute_metrics(pd_run)["rmse"]


@QUIET
def test_what_happens_at_the_edge_of_a_block_or_of_the_scenario_is_as_in_a_run():
    push = "events=[{kind: push, at: 0.9, duration: 0.104, torque: [5.0, 0.0]}]"
    sets = ("duration=1.004", "imperfections={position_noise: 1.0e-4}", push, "seed=7")
    run = simulate(load_scenario("paper", sets, controller="pd"))
    env, law = TrackingEnv("paper", sets, torque_scale=SCALE), pd_law()
    observation, _ = env.reset(seed=7)
    for k in range(len(run)):
        if k % 500 == 0:
            assert len(env.trace()) == k
        observation, *_ = env.step(law(observation))
    check_same(env.trace(), run)


OUTSIDE_HOOKS = """
class Worn:
    def __init__(self, setup):
        self.rng = setup.rng

    def sense(self, t, x):
        return x + 1e-3 * self.rng.standard_normal(x.size)

    def actuate(self, t, tau):
        return 0.9 * tau
"""


def test_imperfections_from_outside_act_in_an_environment_too(tmp_path):
    (tmp_path / "worn.py").write_text(OUTSIDE_HOOKS)
    sets = ["duration=0.2", f"imperfections.external=[{{python: '{tmp_path}/worn.py:Worn'}}]"]
    scenario = load_scenario("paper", sets, controller="pd", trust=True)
    env = TrackingEnv(scenario, torque_scale=SCALE)
    for seed in (1, 4):
        run = simulate(scenario.model_copy(update={"seed": seed}))
        assert np.allclose(run["tau"], 0.9 * run["tau_cmd"])
        play(env, pd_law(), seed=seed)
        check_same(env.trace(), run)


@QUIET
def test_both_show_and_reward_the_same(pd_run):
    env, other = TrackingEnv("paper", SETS), dm.load("paper", (*SETS, "seed=3"))
    flat = dm.load("paper", (*SETS, "seed=3"), flat_observation=True)
    observation, _ = env.reset(seed=3)
    step, flat_step = other.reset(), flat.reset()
    assert list(step.observation) == ["q", "qd", "q_ref", "qd_ref", "qdd_ref", "tau"]
    for action in np.random.default_rng(0).uniform(-1, 1, (50, 2)):
        assert np.array_equal(observation, np.concatenate(list(step.observation.values())))
        assert np.array_equal(observation, flat_step.observation["observations"])
        observation, reward, *_ = env.step(action)
        step, flat_step = other.step(action), flat.step(action)
        assert step.reward == flat_step.reward == reward


def test_the_observation_is_what_a_controller_is_told():
    env = TrackingEnv("paper", SHORT, torque_scale=10.0)
    observation, _ = env.reset(seed=0)
    assert observation[:4].tolist() == [0.5, 0.5, 0.0, 0.0]
    assert observation[4:6].tolist() == [0.0, 1.0]
    assert observation[10:].tolist() == [0.0, 0.0]
    observation, *_ = env.step(np.array([0.3, -2.0]))
    trace = env.trace()
    assert observation[10:].tolist() == [3.0, -10.0] == trace["tau"][0].tolist()
    assert trace.info.status == "unfinished"
    observation, *_ = env.step(np.zeros(2))
    q_ref = np.sin(0.5 * 0.002 + np.array([0.0, np.pi / 2]))
    assert np.allclose(observation[4:6], q_ref)
    assert np.allclose(observation[8:10], -0.25 * q_ref)
    assert len(env.trace()) == 2


def test_an_action_is_held_and_the_reward_is_the_mean_of_its_ticks():
    one = TrackingEnv("paper", ("duration=0.1",))
    ten = TrackingEnv("paper", ("duration=0.1",), control_timestep=0.01)
    other = dm.load("paper", ("duration=0.1",), control_timestep=0.01)
    one.reset(seed=0)
    ten.reset(seed=0)
    other.reset()
    for action in np.random.default_rng(0).uniform(-1, 1, (10, 2)):
        rewards = [one.step(action)[1] for _ in range(10)]
        held = ten.step(action)
        step = other.step(action)
        assert held[1] == pytest.approx(np.mean(rewards), rel=1e-12)
        assert step.reward == held[1]
    assert (held[3], step.step_type) == (True, StepType.LAST)
    assert np.array_equal(one.trace()["q"], ten.trace()["q"])
    assert other.control_timestep() == 0.01


def test_the_reward_is_one_on_the_reference_and_a_half_at_its_precision():
    on = ("initial={q: [0.0, 1.0]}", "reference={kind: setpoint, start: [0, 1], goal: [0, 1],"
          " blend_time: 1}", "plant.gravity=0")  # fmt: skip
    env = TrackingEnv("paper", on)
    env.reset(seed=0)
    assert env.step(np.zeros(2))[1] == 1.0
    env = TrackingEnv("paper", (*on, "initial.q=[0.1, 1.0]"))
    env.reset(seed=0)
    assert env.step(np.zeros(2))[1] == pytest.approx(0.5)
    assert env.step(np.array([1e-9, 1.0]))[1] == pytest.approx(0.5 * (1 - 0.05 / 2), rel=1e-3)


# Seeds


def test_a_seed_is_the_scenario_s_and_decides_an_episode():
    env = TrackingEnv("paper", (*SHORT, "imperfections.position_noise=1e-3"))
    law = pd_law()
    runs = []
    for seed in (1, 1, 2, None, None):
        play(env, law, seed=seed)
        runs.append(env.trace())
    assert np.array_equal(runs[0]["q"], runs[1]["q"])
    for k, one in enumerate(runs[1:]):
        assert not any(np.array_equal(one["q_meas"], other["q_meas"]) for other in runs[k + 2 :])
    assert [run.scenario.seed for run in runs[:3]] == [1, 1, 2]


def test_dm_control_s_episodes_have_one_seed_after_another():
    env = dm.load("paper", (*SHORT, "seed=5"))
    seeds = []
    for _ in range(3):
        env.reset()
        env.step(np.zeros(2))
        seeds.append(env.task.trace().scenario.seed)
    assert seeds == [5, 6, 7]


def test_a_random_start_is_within_its_spread_and_in_the_scenario_of_the_episode():
    env = TrackingEnv("paper", SHORT, spread_q=0.2, spread_qd=0.5, random_phase=True)
    phases, starts = [], []
    for seed in range(20):
        first, _ = env.reset(seed=seed)
        again, _ = env.reset(seed=seed)
        assert np.array_equal(first, again)
        starts.append(first[:4])
        phases.append(env.episode.scenario.reference.phase)
        assert np.allclose(first[4:6], np.sin(phases[-1]))
    away = np.abs(np.array(starts) - [0.5, 0.5, 0.0, 0.0])
    assert (away <= [0.2, 0.2, 0.5, 0.5]).all()
    assert (away.max(axis=0) > [0.1, 0.1, 0.25, 0.25]).all()
    assert np.ptp(phases) > 4.0
    fixed, _ = env.reset(seed=3, options={"spread_q": 0.0, "spread_qd": 0, "random_phase": False})
    assert fixed[:6].tolist() == [0.5, 0.5, 0.0, 0.0, 0.0, 1.0]


# How episodes end


def test_a_divergence_ends_the_episode_with_its_error():
    for sets, action, error in (
        ((), [np.nan, 0.0], "tau = [nan, 0.0] at t = 0 s"),
        (("initial.qd=[2000.0, 0.0]",), [0.0, 0.0], "|qd| = 2000, above 1000 at t = 0 s"),
    ):
        env, other = TrackingEnv("paper", sets), dm.load("paper", sets)
        env.reset(seed=0)
        _, reward, terminated, truncated, info = env.step(np.array(action))
        assert (reward, terminated, truncated, info["error"]) == (0.0, True, False, error)
        assert (info["status"], info["metrics"]["diverged"]) == ("diverged", True)
        other.reset()
        step = other.step(np.array(action))
        assert (step.step_type, step.reward, step.discount) == (StepType.LAST, 0.0, 0.0)
        assert other.task.error == error
        assert other.step(np.zeros(2)).first()
        assert other.task.error == ""


def test_a_divergence_is_told_as_simulate_tells_it(tmp_path):
    file = tmp_path / "wrong.py"
    file.write_text("def make():\n    return lambda o: -1.0 * (o[4:6] - o[:2]) * 1e3\n")
    sets = ["duration=5", "plant.gravity=0"]
    wrong = f"controller={{kind: policy, python: '{file}:make', torque_scale: 9000}}"
    run = simulate(load_scenario("paper", [*sets, wrong], trust=True))
    assert run.info.status == "diverged"
    env = TrackingEnv("paper", tuple(sets), torque_scale=9000.0)
    play(env, lambda o: -1.0 * (o[4:6] - o[:2]) * 1e3, seed=0)
    check_same(env.trace(), run)


def test_after_the_end_a_reset_is_needed():
    env = TrackingEnv("paper", SHORT)
    with pytest.raises(ResetNeeded):
        env.step(np.zeros(2))
    play(env, lambda _: np.zeros(2), seed=0)
    with pytest.raises(ResetNeeded):
        env.step(np.zeros(2))


# What their ecosystems ask


@pytest.mark.filterwarnings("error")
def test_gymnasium_s_checker_has_nothing_to_say():
    env = gymnasium.make(ID, scenario="paper", sets=(*SHORT, "imperfections.position_noise=1e-4"))
    check_env(env.unwrapped, skip_render_check=True)
    env.close()


@pytest.mark.parametrize("mode", ["sync", "async"])
def test_two_at_a_time_by_gymnasium_s_vector_environments(mode):
    envs = gymnasium.make_vec(ID, 2, vectorization_mode=mode, sets=SHORT)
    observations, info = envs.reset(seed=4)
    assert observations.shape == (2, 12)
    assert info["seed"].tolist() == [4, 5]
    for k in range(20):
        _, rewards, _, truncated, info = envs.step(np.zeros((2, 2)))
        assert truncated.tolist() == [k == 19] * 2
    assert info["metrics"]["rmse"].shape == rewards.shape == (2,)
    envs.close()


def test_an_environment_can_be_sent_to_another_process():
    env = TrackingEnv("paper", SHORT, torque_scale=SCALE, spread_q=0.1)
    env.reset(seed=1)
    copy = pickle.loads(pickle.dumps(env))
    first, _ = copy.reset(seed=1)
    assert np.array_equal(first, env.reset(seed=1)[0])


class TestDmEnvironment(EnvironmentTestMixin, unittest.TestCase):
    """dm_env's own conformance tests."""

    def make_object_under_test(self):
        return dm.load("paper", SHORT)

    def make_action_sequence(self):
        yield from np.random.default_rng(0).uniform(-1, 1, (45, 2))  # to the end and beyond


OUTSIDE = """
import gymnasium, numpy as np
from gymnasium.utils.env_checker import check_env

# nothing of dnnmso_mj is imported: the name says where to look
name = "dnnmso_mj.environments.gym:dnnmso_mj/Tracking-v0"
env = gymnasium.make(name, sets=("duration=0.05",), render_mode="rgb_array")
check_env(env.unwrapped)
env.reset(seed=0)
assert env.render().shape == (480, 480, 3)
assert env.render().max() > 100
env.close()

from dm_control.viewer import runtime
from dnnmso_mj.environments import dm

environment = dm.load("paper", ("duration=0.05",))
viewed = runtime.Runtime(environment, policy=lambda step: np.ones(2))
for _ in range(20):
    viewed.tick(0.01, paused=False)
picture = environment.physics.render(240, 320)
assert picture.max() > 100
assert environment.physics.time() > 0
assert environment.physics.named.data.xpos["link2"].any()
"""


@pytest.mark.skipif(
    ctypes.util.find_library("EGL") is None,
    reason="no EGL: apt-get install libegl1 libgl1-mesa-dri",
)
def test_both_can_be_drawn_and_dm_control_s_viewer_can_run_one():
    env = os.environ | {"MUJOCO_GL": "egl"}
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", OUTSIDE],
        env=env, capture_output=True, text=True, check=False, timeout=120,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr


# What is refused


def test_what_no_environment_can_be_made_of_is_refused():
    for make in (TrackingEnv, dm.load):
        with pytest.raises(ScenarioError, match="is no multiple of dt = 0"):
            make("paper", control_timestep=0.0015)
        with pytest.raises(ScenarioError, match=r"spread_q = -1; allowed: a number >= 0"):
            make("paper", spread_q=-1)
        with pytest.raises(ScenarioError, match=r"torque_scale = .* allowed: a number > 0"):
            make("paper", torque_scale=(1.0, 2.0, 3.0))
        with pytest.raises(ScenarioError, match=r"torque_scale = nan; allowed: a number > 0"):
            make("paper", torque_scale=np.nan)
        with pytest.raises(ScenarioError, match="allowed: none beside a loaded scenario"):
            make(load_scenario("paper"), ("duration=1",))
    with pytest.raises(ScenarioError, match='render_mode = human; allowed: None or "rgb_array"'):
        TrackingEnv("paper", render_mode="human")


def test_an_action_of_another_shape_is_refused():
    env = TrackingEnv("setpoint", SHORT)
    env.reset()
    for action in (0.5, [0.5], [0.5, 0.5, 0.5]):
        with pytest.raises(DnnmsoError, match=r"an action of shape \(.*; allowed: \(2,\)"):
            env.step(np.array(action))


def test_options_that_do_not_exist_are_refused():
    env = TrackingEnv("setpoint", SHORT)
    with pytest.raises(ScenarioError, match=r"options: no option phase; allowed: spread_q, "):
        env.reset(options={"phase": 1})
    with pytest.raises(ScenarioError, match="random_phase = true: a setpoint has no phase"):
        env.reset(options={"random_phase": True})
    with pytest.raises(ScenarioError, match="seed = 9223372036854775808; allowed"):
        env.reset(seed=2**63)
