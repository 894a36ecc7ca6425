"""The paper's closed loop as an able user writes it: PyTorch, NumPy and MuJoCo's Python bindings.

The same arm, reference, control law, network and update as `dnnmso_mj.simulation`, and nothing
else: no log, no theory, no checks.
"""

from __future__ import annotations

import time
from collections.abc import Generator
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context

import mujoco
import numpy as np

from dnnmso_mj.errors import DnnmsoError
from dnnmso_mj.network import initial_weights, network_shape
from dnnmso_mj.paths import find_model
from dnnmso_mj.plant import Mjcf, build_spec, compile_spec
from dnnmso_mj.reference import Reference
from dnnmso_mj.scenario import DnnMso, Scenario, expand

Array = np.ndarray


class TorchLoop:
    """One closed loop, from its start.

    Args:
        scenario: the paper's, or one that differs from it in numbers only: dnn_mso, full outputs,
            B from the true inertia, a slack of λ, no torque limit.
        mjcf: the arm; by default the one that the scenario names.

    Attributes:
        q: joint angles (N, n) rad at each tick, so far.
        compute_us: wall time of the control step of each tick (N,) µs.
    """

    def __init__(self, scenario: Scenario, mjcf: Mjcf | None = None) -> None:
        from dnnmso_mj.bench.torch_steps import PlainTorch

        spec, n = scenario.controller, scenario.n_joints
        if not isinstance(spec, DnnMso):
            raise TypeError(f"controller.kind = {spec.kind}; allowed: dnn_mso")
        mjcf = mjcf or Mjcf.read(find_model(scenario.plant.model))
        self._model, self._nominal_model = (
            compile_spec(build_spec(scenario.plant, scenario.dt, mjcf), scenario.plant.model)
            for _ in range(2)
        )
        self._data = mujoco.MjData(self._model)
        self._nominal = mujoco.MjData(self._nominal_model)
        self._data.qpos, self._data.qvel = scenario.initial.q, scenario.initial.qd
        shape = network_shape(spec.network, 2 * n, 2 * n)
        weights = initial_weights(shape, spec.network, np.random.default_rng(scenario.seed))
        self._precision = spec.network.precision
        self._network = PlainTorch(shape, weights.astype(self._precision), spec.madam)
        self._K, self._lam = expand(spec.inversion.K, 2 * n), spec.inversion.lam
        self._K2, self._dt, self._n = expand(spec.observer.K2, 2 * n), scenario.dt, n
        self._x_hat = np.concatenate([self._data.qpos, self._data.qvel])
        self._M = np.zeros((n, n))
        times = np.arange(scenario.n_ticks) * scenario.dt
        q_ref, qd_ref, qdd_ref = Reference(scenario.reference, n).sample(times)
        self._x_ref = np.hstack([q_ref, qd_ref])
        self._xd_ref = np.hstack([qd_ref, qdd_ref])
        self.q = np.zeros((scenario.n_ticks, n))
        self.compute_us = np.zeros(scenario.n_ticks)

    def run(self) -> None:
        """Run to the end of the scenario."""
        data, clock = self._data, time.perf_counter_ns
        for k in range(len(self.q)):
            self.q[k] = data.qpos
            x = np.concatenate([data.qpos, data.qvel])
            began = clock()
            data.ctrl[:] = self._control(x, self._x_ref[k], self._xd_ref[k])
            self.compute_us[k] = (clock() - began) * 1e-3
            mujoco.mj_step(self._model, data)

    def _control(self, x: Array, x_ref: Array, xd_ref: Array) -> Array:
        """Observer, inversion and learning of one tick: torque (n,) N·m."""
        n, network = self._n, self._network
        e_obs = x - self._x_hat
        f_hat = network.predict(x.astype(self._precision, copy=False)).astype(float, copy=False)
        r = xd_ref - self._K * (x - x_ref) - f_hat
        acceleration = r[n:] + self._lam * r[:n]
        tau: Array = self._inertia(x[:n]) @ acceleration
        rate = f_hat + self._K2 * e_obs
        rate[n:] += acceleration
        network.learn(-e_obs.astype(self._precision, copy=False))
        self._x_hat += self._dt * rate
        return tau

    def _inertia(self, q: Array) -> Array:
        """M(q) (n, n) of the nominal model."""
        model, data = self._nominal_model, self._nominal
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_makeM(model, data)
        mujoco.mj_fullM(model, data, self._M)
        return self._M


def pool_of_loops(scenario: Scenario, jobs: int, seeds: range) -> Generator[int]:
    """Run the loop for every seed in a pool of processes; yields each one's ticks when it is done.

    Closing the iterator ends the processes, once the runs under way are done.

    Raises:
        DnnmsoError: a process could not start, or died.
    """
    # Not a multiprocessing.Pool, which starts children that cannot live over and over for ever.
    pool = ProcessPoolExecutor(jobs, mp_context=get_context("spawn"), initializer=_import_torch)
    try:
        tasks = [scenario.model_copy(update={"seed": seed}) for seed in seeds]
        for run in as_completed([pool.submit(_one_loop, task) for task in tasks]):
            yield run.result()
    except BrokenProcessPool as error:
        raise DnnmsoError(
            "a process of the pool of PyTorch loops cannot start or was killed; its own words "
            "stand above; allowed: `dnnmso bench` where `import torch` works and memory is free"
        ) from error
    finally:
        pool.shutdown(cancel_futures=True)


def _import_torch() -> None:
    import torch

    torch.set_num_threads(1)


def _one_loop(scenario: Scenario) -> int:
    loop = TorchLoop(scenario)
    loop.run()
    return len(loop.q)
