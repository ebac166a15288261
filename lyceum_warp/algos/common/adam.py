"""Make steps of Adam (Kingma and Ba 2015, "Adam: A Method for Stochastic Optimization")."""

from collections.abc import Iterable
from typing import Any

import torch

_BETAS = 0.9, 0.999
_EPS = 1e-8


class Adam:
    """Adam with torch's fused kernel, for CUDA graphs: all buffers have fixed addresses.

    torch.optim.Adam runs the same kernel, but its first use imports torch's compiler, which takes seconds.

    Args:
        parameters: The parameters.
        rate: The learning rate; a tensor may change between steps.
        numbers: Length of ``numbers``.
    """

    def __init__(self, parameters: Iterable[torch.Tensor], rate: float | torch.Tensor, *, numbers: int = 0) -> None:
        self.parameters, self.rate = list(parameters), rate
        size = sum(parameter.numel() for parameter in self.parameters)
        self.sums = torch.zeros(size + numbers, device=self.parameters[0].device)
        """``gradient`` and ``numbers`` in one tensor, so that one all-reduce sums both over processes."""
        self.gradient, self.numbers = self.sums[:size], self.sums[size:]
        """The gradient of all parameters, one after the other, which ``step`` reads; and other numbers."""
        self.first, self.second = torch.zeros_like(self.gradient), torch.zeros_like(self.gradient)
        """The moments."""
        self.count = torch.zeros((), device=self.gradient.device)
        """The number of steps."""
        self._parts = [self.shaped(flat) for flat in (self.gradient, self.first, self.second)]

    def shaped(self, flat: torch.Tensor) -> list[torch.Tensor]:
        """Split a flat tensor into views with the shapes of the parameters."""
        sizes = [parameter.numel() for parameter in self.parameters]
        return [part.view_as(p) for part, p in zip(flat.split(sizes), self.parameters, strict=True)]

    @torch.no_grad()
    def step(self) -> None:
        """Make a step with the gradient."""
        self.count += 1
        torch._fused_adam_(  # type: ignore[call-overload]
            self.parameters, *self._parts, [], [self.count] * len(self.parameters), lr=self.rate, beta1=_BETAS[0],
            beta2=_BETAS[1], weight_decay=0.0, eps=_EPS, amsgrad=False, maximize=False,
        )  # fmt: skip

    def state_dict(self) -> dict[str, Any]:
        """Return the state in the format of torch.optim.Adam. The tensors are views."""
        moments = zip(self.shaped(self.first), self.shaped(self.second), strict=True)
        state = {i: {"step": self.count, "exp_avg": m, "exp_avg_sq": v} for i, (m, v) in enumerate(moments)}
        return {"state": state, "param_groups": [{"lr": self.rate, "params": list(state)}]}

    @torch.no_grad()
    def load_state_dict(self, saved: dict[str, Any]) -> None:
        """Restore the moments, the number of steps, and the learning rate if it is a tensor."""
        state = saved["state"]
        for name, flat in (("exp_avg", self.first), ("exp_avg_sq", self.second)):
            for i, part in enumerate(self.shaped(flat)):
                part.copy_(state[i][name]) if state else part.zero_()
        self.count.fill_(float(state[0]["step"]) if state else 0.0)
        if isinstance(self.rate, torch.Tensor):
            self.rate.copy_(saved["param_groups"][0]["lr"])
