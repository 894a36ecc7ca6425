"""Inputs that fuzzing found to break something, each with the error that it gives since."""

from __future__ import annotations

import pytest

from dnnmso_mj.errors import ScenarioError
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
