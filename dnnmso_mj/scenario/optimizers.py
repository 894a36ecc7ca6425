"""The rules that may update a network's weights: the paper's Madam, and its rivals."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from dnnmso_mj.scenario.fields import Strict, refusal

Rate = Annotated[float, Field(gt=0, le=1e3, allow_inf_nan=False)]
Forgetting = Annotated[float, Field(ge=0, lt=1, allow_inf_nan=False)]


class Madam(Strict):
    """Multiplicative adaptive moments, Alg. 1 of the paper."""

    eta: Annotated[float, Field(gt=0, le=1, allow_inf_nan=False)] = 0.001
    """Learning rate η."""
    eta_max: Annotated[float, Field(gt=0, le=1, allow_inf_nan=False)] = 0.1
    """η*, the largest exponent of one update; the paper's 100 η."""
    sigma_max: Annotated[float, Field(ge=1e-3, le=1e6, allow_inf_nan=False)] = 1250.0
    """σ*, the largest magnitude of a weight."""
    beta: Forgetting = 0.999
    """β, the forgetting factor of the second moment."""
    bias_correction: bool = False
    """Divide the second moment by 1 - β^k, as Adam does; the paper's algorithm does not."""

    @model_validator(mode="after")
    def _ordered(self) -> Madam:
        if self.eta_max < self.eta:
            problem = f"is below eta = {self.eta}; allowed: eta_max >= eta"
            raise refusal(("eta_max", problem))
        return self


class ByMadam(Strict):
    """The paper's rule."""

    kind: Literal["madam"]
    """Madam, with the settings that stand under `madam`."""


class Sgd(Strict):
    """Gradient descent, one sample an update."""

    kind: Literal["sgd"]
    """W ← W - η m, m ← momentum m + g."""
    eta: Rate = 0.1
    """Learning rate η."""
    momentum: Forgetting = 0.0
    """Forgetting factor of the sum of gradients; 0 is plain gradient descent."""


class Adam(Strict):
    """Adaptive moments, with bias correction."""

    kind: Literal["adam"]
    """W ← W - η m̂/(√v̂ + ε)."""
    eta: Rate = 0.001
    """Learning rate η."""
    beta1: Forgetting = 0.9
    """Forgetting factor of the first moment."""
    beta2: Forgetting = 0.999
    """Forgetting factor of the second moment."""
    eps: Annotated[float, Field(ge=1e-30, le=1, allow_inf_nan=False)] = 1e-8
    """ε, which keeps the smallest gradients from making full steps."""


class SignSgd(Strict):
    """Descent by the gradient's signs alone."""

    kind: Literal["sign_sgd"]
    """W ← W - η sign(g)."""
    eta: Rate = 0.001
    """Learning rate η: the size of every step of every weight."""


Optimizer = Annotated[ByMadam | Sgd | Adam | SignSgd, Field(discriminator="kind")]
Rule = Madam | Sgd | Adam | SignSgd


def chosen(optimizer: ByMadam | Sgd | Adam | SignSgd, madam: Madam) -> Rule:
    """The rule that a controller's two keys name."""
    return madam if isinstance(optimizer, ByMadam) else optimizer


def check_resolvable(rule: Rule, precision: Literal["float64", "float32"]) -> None:
    """Refuse learning whose smallest steps are rounded away in the network's arithmetic."""
    eps = float(np.finfo(precision).eps)
    least = f"2^{round(np.log2(eps))} = {eps:.2g}, what {precision} resolves"
    if isinstance(rule, Madam) and rule.eta < eps:
        raise refusal(
            ("madam.eta", f"would leave every weight as it is; allowed: {least}, or more")
        )
    key, beta = _slowest(rule)
    if 1 - beta < eps:
        name = key.rsplit(".", 1)[-1]
        problem = f"would never take in a gradient; allowed: 1 - {name} of {least}, or more"
        raise refusal((key, problem))


def _slowest(rule: Rule) -> tuple[str, float]:
    """The forgetting factor nearest to 1, and its key."""
    match rule:
        case Madam():
            return "madam.beta", rule.beta
        case Adam():
            betas = {"optimizer.beta1": rule.beta1, "optimizer.beta2": rule.beta2}
            return max(betas.items(), key=lambda item: item[1])
        case Sgd():
            return "optimizer.momentum", rule.momentum
    return "optimizer", 0.0
