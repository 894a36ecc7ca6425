"""The update rules as torch optimisers: the reference of the kernel's."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch

from dnnmso_mj.madam import Madam
from dnnmso_mj.scenario import Adam, Rule, Sgd, SignSgd
from dnnmso_mj.scenario import Madam as MadamSpec

# What each rule calls its moments in torch.
FIRST_MOMENT: dict[type[Rule], str] = {Sgd: "momentum_buffer", Adam: "exp_avg"}
SECOND_MOMENT: dict[type[Rule], str] = {MadamSpec: "g_bar_sq", Adam: "exp_avg_sq"}


class Sign(torch.optim.Optimizer):
    """W ← W − η sign(g), Bernstein et al. 2018."""

    def __init__(self, params: Sequence[torch.Tensor], eta: float) -> None:
        super().__init__(params, defaults={"eta": eta})

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> float | None:  # type: ignore[override]
        """Update every parameter from its `.grad`."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        for group in self.param_groups:
            for W in group["params"]:
                if W.grad is not None:
                    W.sub_(group["eta"] * torch.sign(W.grad))
        return loss


def build_optimizer(params: Sequence[torch.Tensor], rule: Rule) -> torch.optim.Optimizer:
    """The optimiser that a scenario asks for."""
    match rule:
        case MadamSpec():
            return Madam(params, rule)
        case Sgd():
            return torch.optim.SGD(params, lr=rule.eta, momentum=rule.momentum)
        case Adam():
            betas = (rule.beta1, rule.beta2)
            return torch.optim.Adam(params, lr=rule.eta, betas=betas, eps=rule.eps)
        case SignSgd():
            return Sign(params, rule.eta)


def moment(optimizer: torch.optim.Optimizer, name: str | None, W: torch.Tensor) -> torch.Tensor:
    """A moment of one parameter; zeros before the first update, and for a rule without it."""
    found = optimizer.state[W].get(name) if name else None
    return torch.zeros_like(W) if found is None else found


def put_back(
    optimizer: torch.optim.Optimizer,
    rule: Rule,
    W: torch.Tensor,
    updates: int,
    first: torch.Tensor,
    second: torch.Tensor,
) -> None:
    """Give a parameter the moments and the number of updates that it goes on from."""
    state: dict[str, Any] = optimizer.state[W]
    match rule:
        case MadamSpec():
            state.update(k=updates, g_bar_sq=second)
        case Adam():
            state.update(step=torch.tensor(float(updates)), exp_avg=first, exp_avg_sq=second)
        case Sgd():
            state.update(momentum_buffer=first)
