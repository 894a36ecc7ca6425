"""Inputs that fuzzing found to break something, each with the error that it gives since."""

from __future__ import annotations

import pytest

from dnnmso_mj.errors import ScenarioError
from dnnmso_mj.loading import load_scenario
from dnnmso_mj.mjcf import gate


@pytest.mark.parametrize(
    "element",
    [
        '<asset><hfield name="h" nrow="3" ncol="1 0 0 0" size="1 1 1 1"/></asset>',
        '<asset><texture name="t" type="2d" builtin="flat" width="1 2" height="1"/></asset>',
        '<worldbody><replicate count="1 2"><geom size="1"/></replicate></worldbody>',
    ],
)
def test_several_numbers_where_one_may_stand_are_refused(element):
    with pytest.raises(ScenarioError, match=r"is not one number; allowed: a decimal number"):
        gate(f"<mujoco>{element}</mujoco>")


def test_a_yaml_version_that_is_none_is_refused():
    with pytest.raises(ScenarioError, match=r"%YAML of a version that is none; allowed: YAML 1\.2"):
        load_scenario("paper", ["seed=%YAML 1.11"])


@pytest.mark.parametrize("depth", [33, 400, 5000])
def test_keys_of_a_set_that_lead_too_deep_are_refused(depth):
    with pytest.raises(ScenarioError, match=rf"--set .*: {depth} keys deep; allowed: at most 32"):
        load_scenario("paper", [f"{'.'.join('a' * depth)}=1"])
