"""Masses and lengths of a scenario on a model: where they fit, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest

from dnnmso_mj.errors import ScenarioError
from dnnmso_mj.plant import Mjcf, NominalModel, Plant
from dnnmso_mj.scenario import Plant as PlantSpec

MOTORS = "".join(f'<motor joint="j{k}"/>' for k in (1, 2))

ARM = f"""<mujoco><compiler angle="degree"/><option><flag contact="disable"/></option><worldbody>
  <body name="link1" pos="0 0 1" euler="0 0 30">
    <inertial pos="0.1 0 0" mass="3" fullinertia="0.02 0.03 0.04 0.001 0 0"/>
    <joint name="j1" axis="0 -1 0"/>
    <body name="link2" pos="0.4 0 0">
      <inertial pos="0.2 0 0" mass="2" diaginertia="0.01 0.02 0.03"/>
      <joint name="j2" axis="0 -1 0"/>
      <geom size="0.1"/>
    </body>
  </body>
</worldbody><actuator>{MOTORS}</actuator></mujoco>"""

SET = {"masses": [1.0, 2.0], "lengths": [0.5, 0.7]}


def model_of(make_scenario, text, **plant):
    scenario = make_scenario(plant={"model": "mine.xml", **plant})
    return Plant(scenario, Mjcf(text)).model


def test_a_model_of_ones_own_keeps_its_masses_and_lengths_unless_told(make_scenario):
    model = model_of(make_scenario, ARM)
    assert model.body_mass.tolist() == [0.0, 3.0, 2.0]
    assert model.body("link2").pos.tolist() == [0.4, 0.0, 0.0]
    assert model.body("link1").ipos.tolist() == [0.1, 0.0, 0.0]


def test_masses_and_lengths_are_put_on_any_chain_along_x(make_scenario):
    model = model_of(make_scenario, ARM, **SET)
    assert model.body_mass.tolist() == [0.0, 1.0, 2.0]
    assert model.body("link1").ipos.tolist() == model.body("link2").pos.tolist() == [0.5, 0, 0]
    assert model.body_inertia[1:].max() < 1e-13  # what the file says of a full inertia is gone
    assert model.body("link1").pos.tolist() == [0.0, 0.0, 1.0]


def test_what_is_set_alone_is_refused_on_a_model_of_ones_own():
    with pytest.raises(ValueError, match="masses stands alone"):
        PlantSpec(model="mine.xml", masses=(1.0, 2.0))
    assert PlantSpec(masses=(1.0, 2.0)).lengths == (1.0, 1.0)


OTHERS = {
    "a branch": ('<geom size="0.1"/>\n    </body>', '<geom size="0.1"/></body><body name="cup"/>'),
    "up": ('pos="0.4 0 0"', 'pos="0 0 0.4"'),
    "backwards": ('pos="0.4 0 0"', 'pos="-0.4 0 0"'),
    "nowhere": ('pos="0.4 0 0"', 'pos="0 0 0"'),
    "turned": ('pos="0.4 0 0"', 'pos="0.4 0 0" euler="0 0 1"'),
    "joint aside": ('"j2" axis', '"j2" pos="0.1 0 0" axis'),
    "another order": ('name="link2"', 'name="link3"'),
    "mass of geoms": ('angle="degree"', 'inertiafromgeom="true"'),
    "total mass": ('angle="degree"', 'settotalmass="10"'),
    "least mass": ('angle="degree"', 'boundmass="1.5"'),
    "least inertia": ('angle="degree"', 'boundinertia="0.1"'),
}
SAID = {
    "a branch": r"body 'link1' carries 2 bodies \(link2, cup\)",
    "up": r"body 'link2' stands at \(0, 0, 0\.4\), not along \+x",
    "backwards": r"body 'link2' stands at \(-0\.4, 0, 0\)",
    "nowhere": r"body 'link2' stands at \(0, 0, 0\)",
    "turned": "body 'link2' is turned against body 'link1'",
    "joint aside": "body 'link2' has its joint 'j2' away from its origin",
    "another order": "no body 'link2' .it has: link1, link3",
    "mass of geoms": "body 'link2' is set to 2 kg, but MuJoCo makes 4.189 kg",
    "total mass": "body 'link1' is set to 1 kg, but MuJoCo makes 3.333 kg",
    "least mass": "body 'link1' is set to 1 kg, but MuJoCo makes 1.5 kg",
    "least inertia": "body 'link1' gets 0.1 kg·m² from MuJoCo",
}


@pytest.mark.filterwarnings("ignore:compiler attribute 'settotalmass' is deprecated")
@pytest.mark.parametrize("case", OTHERS)
def test_masses_are_refused_where_they_would_bend_the_model(make_scenario, case):
    old, new = OTHERS[case]
    assert ARM.count(old) == 1
    text = ARM.replace(old, new)
    with pytest.raises(ScenarioError, match=SAID[case]) as caught:
        model_of(make_scenario, text, **SET)
    assert "null masses and lengths" in str(caught.value)
    assert model_of(make_scenario, text).njnt == 2  # and taken as it is without them


def test_a_frame_between_two_links_is_refused(make_scenario):
    text = ARM.replace(
        '<body name="link2" pos="0.4 0 0">',
        '<frame pos="0.1 0 0"><body name="link2" pos="0.3 0 0">',
    )
    text = text.replace("</body>\n  </body>", "</body></frame></body>")
    with pytest.raises(ScenarioError, match="body 'link2' stands in a <frame>"):
        model_of(make_scenario, text, **SET)


def test_a_tool_on_the_last_link_goes_to_its_tip(make_scenario):
    tool = '<geom size="0.1"/><body name="tool" pos="0.3 0 0"><geom size="0.02" mass="0.2"/></body>'
    model = model_of(make_scenario, ARM.replace('<geom size="0.1"/>', tool), **SET)
    assert model.body("tool").pos.tolist() == [0.7, 0.0, 0.0]
    assert model.body("tool").mass == pytest.approx(0.2)


def test_the_controllers_wrong_masses_are_held_to_the_same_rules(make_scenario):
    effectiveness = {"kind": "inertia", "masses": [1.0, 1.0], "lengths": [1.0, 1.0]}
    controller = {"kind": "dnn_mso", "inversion": {"effectiveness": effectiveness}}
    scenario = make_scenario(controller, plant={"model": "mine.xml"})
    assert np.trace(NominalModel(scenario, Mjcf(ARM)).inertia(np.zeros(2))) == pytest.approx(6.0)
    with pytest.raises(ScenarioError, match="turned"):
        NominalModel(scenario, Mjcf(ARM.replace(*OTHERS["turned"])))
