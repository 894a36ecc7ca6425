"""Madam, the multiplicative adaptive moments optimiser, as the reference in torch.

    ḡ² ← (1−β) g² + β ḡ²
    W  ← W ⊙ exp[−η sign(W) ⊙ clamp_{η*/η}(g/ḡ)]
    W  ← clamp_{σ*}(W)

Source: the paper's Alg. 1; Bernstein et al. 2021, "Learning compositional functions via
multiplicative weight updates", written anew from the papers. The compiled counterpart is
`dnnmso_mj.kernel.learn`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import torch

from dnnmso_mj.errors import NonFiniteError
from dnnmso_mj.scenario import Madam as MadamSpec


class Madam(torch.optim.Optimizer):
    """Alg. 1 for torch parameters.

    Signs never change, a zero weight never moves, |ΔW| ≤ (e^{η*} − 1)|W|, |W| ≤ σ*; 0/0 is no
    update.

    N.B. as printed there is no bias correction, so the first updates are up to 1/√(1−β) times bold;
    `bias_correction` divides ḡ² by 1 − βᵏ.

    Args:
        params: the weights.
        spec: η, η*, σ*, β and bias_correction.

    Raises:
        NonFiniteError: from `step`, when a gradient is not finite.
    """

    def __init__(self, params: Iterable[torch.Tensor], spec: MadamSpec) -> None:
        super().__init__(params, defaults={})
        self.spec = spec

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
                    self._update(W, W.grad, self.state[W])
        return loss

    def _update(self, W: torch.Tensor, g: torch.Tensor, state: dict[str, Any]) -> None:
        spec = self.spec
        if not torch.isfinite(g).all():
            raise NonFiniteError("gradient", float(g[~torch.isfinite(g)][0]))
        if not state:
            state["k"], state["g_bar_sq"] = 0, torch.zeros_like(W)
        state["k"] += 1
        g_bar_sq = state["g_bar_sq"]
        g_bar_sq.mul_(spec.beta).addcmul_(g, g, value=1 - spec.beta)
        correction = 1 - spec.beta ** state["k"] if spec.bias_correction else 1.0
        ratio = torch.where(g_bar_sq > 0, g / torch.sqrt(g_bar_sq / correction), 0.0)
        most = spec.eta_max / spec.eta
        W.mul_(torch.exp(-spec.eta * torch.sign(W) * ratio.clamp(-most, most)))
        W.clamp_(-spec.sigma_max, spec.sigma_max)
