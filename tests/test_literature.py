"""Scenarios of other papers: their plants are the published formulas, and they ship by name."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from dnnmso_mj.loading import list_scenarios, load_scenario
from dnnmso_mj.paths import find_model, scenarios_dir
from dnnmso_mj.plant import Mjcf, NominalModel
from dnnmso_mj.reference import Reference
from dnnmso_mj.simulation import simulate

FILES = sorted((scenarios_dir() / "literature").glob("*.yaml"))


def lewis(q, qd):
    """M, V and G of point masses m1 = 0.8, m2 = 2.3 with l = 1, g = 9.8."""
    (m1, m2), (s2, c2) = (0.8, 2.3), (np.sin(q[1]), np.cos(q[1]))
    M = np.array([[(m1 + m2) + m2 + 2 * m2 * c2, m2 + m2 * c2], [m2 + m2 * c2, m2]])
    V = np.array([-m2 * (2 * qd[0] * qd[1] + qd[1] ** 2) * s2, m2 * qd[0] ** 2 * s2])
    outer = m2 * 9.8 * np.cos(q[0] + q[1])
    return M, V, np.array([(m1 + m2) * 9.8 * np.cos(q[0]) + outer, outer])


def lb_dnn(q, qd):
    """M and V_m q̇ with p = (3.473, 0.196, 0.242); there is no gravity."""
    p1, p2, p3 = 3.473, 0.196, 0.242
    s2, c2 = np.sin(q[1]), np.cos(q[1])
    M = np.array([[p1 + 2 * p3 * c2, p2 + p3 * c2], [p2 + p3 * c2, p2]])
    V_m = np.array([[-p3 * s2 * qd[1], -p3 * s2 * (qd[0] + qd[1])], [p3 * s2 * qd[0], 0.0]])
    return M, V_m @ qd, np.zeros(2)


ARMS = {"lewis": lewis, "lb_dnn": lb_dnn}
F_D = np.array([5.3, 1.1])
every_arm = pytest.mark.parametrize("name", ["lewis", "lb_dnn"])


def test_each_file_has_its_formula_here():
    assert {file.stem for file in FILES} == set(ARMS)


@pytest.mark.parametrize("name", ARMS)
def test_it_loads_by_name_without_a_warning_and_is_listed(name):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scenario = load_scenario(f"literature/{name}")
    assert scenario.name == name
    assert (f"literature/{name}", scenario.description) in list_scenarios()


@every_arm
def test_its_plant_is_the_published_formula(name):
    scenario = load_scenario(f"literature/{name}")
    model = NominalModel(scenario, Mjcf.read(find_model(scenario.plant.model)))
    rng = np.random.default_rng(0)
    for _ in range(200):
        q, qd = rng.uniform(-np.pi, np.pi, 2), rng.normal(0.0, 3.0, 2)
        M, V, G = ARMS[name](q, qd)
        scale = np.abs(M).max() * (1 + qd @ qd) + np.abs(G).max()
        assert np.abs(model.inertia(q) - M).max() <= 1e-12 * np.abs(M).max()
        assert np.abs(model.bias(q, np.zeros(2)) - G).max() <= 1e-12 * scale
        assert np.abs(model.bias(q, qd) - V - G).max() <= 1e-12 * scale


def test_lewis_follows_a_sine_and_a_cosine_from_rest_at_zero():
    scenario = load_scenario("literature/lewis")
    t = np.linspace(0.0, 10.0, 101)
    q_ref, _, _ = Reference(scenario.reference, 2).sample(t)
    assert np.allclose(q_ref, np.stack([np.sin(t), np.cos(t)], axis=1), atol=1e-15)
    assert (scenario.initial.q, scenario.initial.qd) == ((0.0, 0.0), (0.0,))


def test_lb_dnn_follows_the_published_trajectory():
    """With q̇_ref and q̈_ref as the code of the paper spells them out."""
    scenario = load_scenario("literature/lb_dnn")
    t = np.linspace(0.0, 100.0, 1001)
    q_ref, qd_ref, qdd_ref = Reference(scenario.reference, 2).sample(t)
    e, s, c = 0.25 * np.exp(-np.sin(t)), np.sin(t), np.cos(t)
    circle, tangent = np.stack([s, c]), np.stack([c, -s])
    assert np.allclose(q_ref.T, e * circle, atol=1e-13)
    assert np.allclose(qd_ref.T, e * tangent - e * c * circle, atol=1e-13)
    expected = -e * c * tangent - e * circle + e * c**2 * circle + e * s * circle - e * c * tangent
    assert np.allclose(qdd_ref.T, expected, atol=1e-13)


def test_lb_dnn_has_the_published_friction():
    """Without a torque, f_true = −M⁻¹ (V_m q̇ + F_d q̇) and nothing else moves the arm."""
    scenario = load_scenario("literature/lb_dnn", ["duration=0.2", "initial.qd=[1.0, -2.0]"])
    trace = simulate(scenario)
    for q, qd, f in zip(trace["q"], trace["qd"], trace["f_true"], strict=True):
        M, V, _ = lb_dnn(q, qd)
        assert np.allclose(f[2:], -np.linalg.solve(M, V + F_D * qd), rtol=1e-9, atol=1e-9)


@every_arm
def test_the_network_follows_the_arm_of_the_paper(name):
    trace = simulate(load_scenario(f"literature/{name}", ["duration=10.0"]))
    error = (trace["q"] - trace["q_ref"])[5000:]
    assert np.sqrt((error**2).mean()) < 5e-3
