"""The typed dynamic inversion of a controller."""

from __future__ import annotations

import numpy as np
from pydantic import model_validator

from dnnmso_mj.scenario.effectiveness import Effectiveness, Inertia
from dnnmso_mj.scenario.fields import Matrix, NonNegative, PositiveEach, Strict, refusal


class Inversion(Strict):
    """Dynamic inversion with slack augmentation, Eq. 10 and after."""

    K: PositiveEach = (7.5,)
    """Tracking gain (1/s): one number, or one for each of the 2n states."""
    lam: NonNegative = 7.5
    """λ of the slack matrix B_s = [I; -λI] (1/s). The paper leaves B_s open."""
    slack_matrix: Matrix | None = None
    """A general slack matrix B_s, 2n rows of n; it replaces lam."""
    effectiveness: Effectiveness = Inertia(kind="inertia")
    """What the controller takes for B."""

    @model_validator(mode="after")
    def _invertible(self) -> Inversion:
        if self.slack_matrix is None:
            return self
        rows, widths = len(self.slack_matrix), {len(row) for row in self.slack_matrix}
        if widths != {rows // 2} or rows % 2:
            problem = "has rows that do not fit; allowed: 2n rows of n numbers each"
            raise refusal(("slack_matrix", problem))
        upper = np.array(self.slack_matrix[: rows // 2])
        if np.linalg.matrix_rank(upper) < rows // 2:
            problem = "leaves [B B_s] without an inverse; allowed: regular upper n rows"
            raise refusal(("slack_matrix", problem))
        return self
