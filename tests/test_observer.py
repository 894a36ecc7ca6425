"""The observer's start, memory and correction for the torque that acted, beside its error law."""

from __future__ import annotations

import numpy as np
import pytest

from dnnmso_mj.inversion import DynamicInversion, build_inversion, invert
from dnnmso_mj.observer import (
    StateObserver,
    advance,
    begin,
    build_observer,
    compare,
    correct,
    held,
    hold,
    start,
)
from dnnmso_mj.plant import NominalModel
from dnnmso_mj.scenario import Inversion, Observer

DT = 0.01
CONSTANT = {"kind": "constant", "b": 0.4}


@pytest.fixture
def nominal(make_scenario, two_link) -> NominalModel:
    return NominalModel(make_scenario(), two_link)


def pair(
    nominal: NominalModel, *, torque: str = "applied", effectiveness: dict | None = None
) -> tuple[StateObserver, DynamicInversion]:
    spec = Inversion(effectiveness=effectiveness or {"kind": "inertia"})
    inversion = build_inversion(spec, 2, nominal.view)
    return build_observer(Observer(K2=[3.0], torque=torque), 4, DT), inversion


def command(inversion: DynamicInversion, seed: int = 0) -> np.ndarray:
    """A command at a random state; returns u."""
    invert(inversion, *np.random.default_rng(seed).normal(size=(4, 4)))
    return inversion.tau.copy()


def test_the_observer_has_an_entry_for_each_state_and_scratch_for_each_joint():
    observer = build_observer(Observer(K2=[3.0]), 6, DT)
    assert {array.shape for array in (observer.x_hat, observer.e_obs, observer.gain)} == {(6,)}
    assert (observer.free.shape, observer.change.shape, observer.L.shape) == ((3,), (3,), (3, 3))
    assert observer.dt == DT


def test_the_observer_starts_at_the_measured_state():
    observer = build_observer(Observer(), 4, DT)
    observer.e_obs[:] = observer.x_hat[:] = 9.0
    x = np.array([0.1, -0.2, 0.3, -0.4])
    start(observer, x)
    compare(observer, x)
    assert observer.x_hat.tolist() == x.tolist()
    assert not observer.e_obs.any()


@pytest.mark.parametrize("effectiveness", [None, CONSTANT])
def test_correcting_is_as_if_the_torque_that_acted_had_been_commanded(nominal, effectiveness):
    """X̂ after `advance` with B u, then `correct` with τ, is X̂ after `advance` with B τ."""
    observer, inversion = pair(nominal, effectiveness=effectiveness)
    begin(observer, inversion, np.array([0.5, 0.5, 0.1, -0.3]))
    u, acted = command(inversion), np.array([4.0, -7.0])
    B2 = np.linalg.inv(inversion.B2_inv)
    f_hat = np.array([0.3, -0.1, 2.0, 1.0])
    compare(observer, np.array([0.6, 0.4, 0.2, -0.2]))
    expected = observer.x_hat + DT * (f_hat + 3.0 * observer.e_obs)
    expected[2:] += DT * B2 @ acted
    advance(observer, f_hat, inversion.Bu)
    assert not np.allclose(observer.x_hat, expected, rtol=1e-3)
    correct(observer, inversion, acted)
    np.testing.assert_allclose(observer.x_hat, expected, rtol=1e-12)
    assert inversion.tau.tolist() == u.tolist()


def test_a_torque_that_acted_as_commanded_corrects_nothing(nominal):
    observer, inversion = pair(nominal)
    begin(observer, inversion, np.ones(4))
    correct(observer, inversion, command(inversion))
    assert observer.x_hat.tolist() == [1.0] * 4


def test_an_observer_that_takes_its_command_for_what_acted_is_not_corrected(nominal):
    observer, inversion = pair(nominal, torque="commanded")
    begin(observer, inversion, np.ones(4))
    command(inversion)
    correct(observer, inversion, np.array([40.0, -70.0]))
    assert observer.x_hat.tolist() == [1.0] * 4


@pytest.mark.parametrize(("effectiveness", "b"), [(None, 1.0), (CONSTANT, 0.4)])
def test_before_the_first_command_no_torque_was_commanded(nominal, effectiveness, b):
    """B₂ is then b·I, or I where it is an inertia's: there is no state yet to take M(q) at."""
    observer, inversion = pair(nominal, effectiveness=effectiveness)
    assert inversion.B2_inv.tolist() == (np.eye(2) / b).tolist()
    command(inversion)
    begin(observer, inversion, np.zeros(4))
    assert not inversion.tau.any()
    correct(observer, inversion, np.array([2.0, -1.0]))
    np.testing.assert_allclose(observer.x_hat, [0.0, 0.0, 2.0 * b * DT, -b * DT], rtol=1e-14)


def test_what_was_held_is_put_back_as_it_was_then(nominal):
    observer, inversion = pair(nominal)
    begin(observer, inversion, np.array([0.1, 0.2, 0.3, 0.4]))
    u, B2_inv = command(inversion), inversion.B2_inv.copy()
    state = held(observer, inversion)
    observer.x_hat[:] = 9.0
    command(inversion, seed=1)
    assert not np.array_equal(inversion.tau, u)
    other, others = pair(nominal)
    for one, law in ((observer, inversion), (other, others)):
        hold(one, law, state)
        assert one.x_hat.tolist() == [0.1, 0.2, 0.3, 0.4]
        assert np.array_equal(law.tau, u)
        assert np.array_equal(law.B2_inv, B2_inv)


def test_a_state_has_these_names_in_every_log():
    observer = build_observer(Observer(), 2, DT)
    inversion = build_inversion(Inversion(effectiveness=CONSTANT), 1, None)
    assert sorted(held(observer, inversion)) == ["B2_inv", "tau", "x_hat"]
