"""The tip of the last link: where payloads are fixed, and where forces push."""

from __future__ import annotations

import mujoco
import numpy as np

from dnnmso_mj.errors import ScenarioError
from dnnmso_mj.plant import TIP

Array = np.ndarray

SLACK = 1e-9


class Tip:
    """The site named tip of a live model; where links have lengths, the end of the last one.

    Args:
        model: changed by `carry`.
        name: of the model, for messages.

    Attributes:
        site: MuJoCo's number of it.

    Raises:
        ScenarioError: the model has no such site.
    """

    def __init__(self, model: mujoco.MjModel, name: str) -> None:
        self._model = model
        self.site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, TIP)
        if self.site < 0:
            raise ScenarioError(
                f"events: plant.model = {name} does not say where its tip is; allowed: a "
                f'<site name="{TIP}"> on its last link, or plant.masses and plant.lengths'
            )
        self._body = int(model.site_bodyid[self.site])
        self._place = model.site_pos[self.site].copy()
        self._bare = {name: array.copy() for name, array in self._inertial().items()}
        self._frames = [array.copy() for array in self._frame_flags()]

    def _inertial(self) -> dict[str, Array]:
        """Live views of what MuJoCo knows of the body's inertia, in its own frame."""
        model, body = self._model, slice(self._body, self._body + 1)
        return {
            "mass": model.body_mass[body],
            "centre": model.body_ipos[body],
            "moments": model.body_inertia[body],
            "axes": model.body_iquat[body],
        }

    def _frame_flags(self) -> list[Array]:
        """Where MuJoCo keeps which frames coincide, to compute them once."""
        model = self._model
        return [model.body_sameframe, model.geom_sameframe, model.site_sameframe]

    def name(self) -> str:
        """Of the body that the tip is on."""
        return str(self._model.body(self._body).name)

    def loaded(self, payload: float) -> dict[str, Array]:
        """The body's inertial parameters with a point mass (kg) at the tip, by Steiner's theorem.

        Raises:
            ScenarioError: the mass or a moment of inertia that is left is not positive.
        """
        bare = {name: array[0] for name, array in self._bare.items()}
        mass = float(bare["mass"]) + payload
        if mass <= 0.0:
            raise self._refuse(f"leaves {mass:.4g} kg; allowed: above -{bare['mass']:.6g} kg")
        centre = (bare["mass"] * bare["centre"] + payload * self._place) / mass
        rotation = np.zeros(9)
        mujoco.mju_quat2Mat(rotation, bare["axes"])
        R = rotation.reshape(3, 3)
        inertia = R @ np.diag(bare["moments"]) @ R.T
        inertia += bare["mass"] * _steiner(bare["centre"] - centre)
        inertia += payload * _steiner(self._place - centre)
        moments, axes = np.linalg.eigh(inertia)
        if moments[0] < -SLACK * moments[-1]:
            raise self._refuse("leaves a negative moment of inertia; allowed: a lighter one")
        axes[:, 2] *= np.linalg.det(axes)  # right-handed
        quaternion = np.zeros(4)
        mujoco.mju_mat2Quat(quaternion, axes.flatten())
        moments = np.maximum(moments, 0.0)
        return {"mass": np.array([mass]), "centre": centre, "moments": moments, "axes": quaternion}

    def _refuse(self, problem: str) -> ScenarioError:
        return ScenarioError(f"the payload at the tip of body '{self.name()}' {problem}")

    def carry(self, payload: float) -> None:
        """Have the body as in the file with a point mass (kg) at its tip; 0 takes it off."""
        model = self._model
        values = self.loaded(payload) if payload else self._bare
        for name, view in self._inertial().items():
            view[:] = values[name]
        for flags, bare in zip(self._frame_flags(), self._frames, strict=True):
            flags[:] = bare
        if payload:
            _forget_inertial_frame(model, self._body)
        mujoco.mj_setConst(model, mujoco.MjData(model))


def _steiner(arm: Array) -> Array:
    """Inertia of a unit point mass about the centre at distance `arm` (3,) m: (3, 3) m²."""
    inertia: Array = arm @ arm * np.eye(3) - np.outer(arm, arm)
    return inertia


def _forget_inertial_frame(model: mujoco.MjModel, body: int) -> None:
    """The body's inertial frame has moved: nothing coincides with it any more."""
    model.body_sameframe[body] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE
    for parts, bodies in (
        (model.geom_sameframe, model.geom_bodyid),
        (model.site_sameframe, model.site_bodyid),
    ):
        parts[bodies == body] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE
