"""Make steps of Adam (Kingma and Ba 2015, "Adam: A Method for Stochastic Optimization")."""

import math
from collections.abc import Iterable
from typing import Any

import torch

from lyceum_warp.algos.common.distributed import Team, flatten, unflatten
from lyceum_warp.support.upstream import fused_adam

BETAS = 0.9, 0.999
EPS = 1e-8


class Adam:
    """Adam with torch's fused kernel, for CUDA graphs: all buffers have fixed addresses.

    torch.optim.Adam runs the same kernel, but its first use imports torch's compiler, which takes seconds.

    Args:
        parameters: The parameters.
        rate: The learning rate; a tensor may change between steps.
        numbers: Length of the other numbers in ``sums``.
    """

    def __init__(self, parameters: Iterable[torch.Tensor], rate: float | torch.Tensor, *, numbers: int = 0) -> None:
        self.parameters, self.rate = list(parameters), rate
        size = sum(parameter.numel() for parameter in self.parameters)
        self.sums = torch.zeros(size + numbers, device=self.parameters[0].device)
        """The gradient and other numbers in one tensor, so that one all-reduce sums both over processes."""
        self.gradient = self.sums[:size]
        """The gradient of all parameters, one after the other, which ``step`` reads."""
        self.first, self.second = torch.zeros_like(self.gradient), torch.zeros_like(self.gradient)
        """The moments."""
        self.count = torch.zeros((), device=self.gradient.device)
        """The number of steps."""
        self._parts = [unflatten(vector, self.parameters) for vector in (self.gradient, self.first, self.second)]

    @torch.no_grad()
    def step(self) -> None:
        """Make a step with the gradient."""
        self.count += 1
        fused_adam(
            self.parameters, *self._parts, [], [self.count] * len(self.parameters), lr=self.rate, beta1=BETAS[0],
            beta2=BETAS[1], weight_decay=0.0, eps=EPS, amsgrad=False, maximize=False,
        )  # fmt: skip

    def state_dict(self) -> dict[str, Any]:
        """Return the state in the format of torch.optim.Adam. The tensors are views."""
        moments = zip(self._parts[1], self._parts[2], strict=True)
        state = {i: {"step": self.count, "exp_avg": m, "exp_avg_sq": v} for i, (m, v) in enumerate(moments)}
        return {"state": state, "param_groups": [{"lr": self.rate, "params": list(state)}]}

    @torch.no_grad()
    def load_state_dict(self, saved: dict[str, Any]) -> None:
        """Restore the moments, the number of steps and the learning rate."""
        state = saved["state"]
        for name, parts in zip(("exp_avg", "exp_avg_sq"), self._parts[1:], strict=True):
            for i, part in enumerate(parts):
                part.copy_(state[i][name]) if state else part.zero_()
        self.count.fill_(float(state[0]["step"]) if state else 0.0)
        rate = saved["param_groups"][0]["lr"]
        if isinstance(self.rate, torch.Tensor):
            self.rate.copy_(rate)
        else:
            self.rate = float(rate)


class GradientStep:
    """Makes Adam steps on the parameters that are not frozen, with gradients summed over all processes.

    ``max_norm`` is the maximum Euclidean norm of the gradient.
    """

    def __init__(
        self, parameters: Iterable[torch.Tensor], rate: float, team: Team, *, max_norm: float = math.inf
    ) -> None:
        self.parameters, self.team, self.max_norm = [p for p in parameters if p.requires_grad], team, max_norm
        self.optimizer = Adam(self.parameters, rate)

    def __call__(self, loss: torch.Tensor, *numbers: torch.Tensor) -> torch.Tensor:
        """Make a gradient step, and return the loss and ``numbers``, each summed over all processes."""
        # backward() accumulates on the CUDA stream of its first call
        gradients = torch.autograd.grad(loss, self.parameters)
        details = torch.stack([number.detach().float() for number in (loss, *numbers)])
        sums = self.team.sum(flatten(part.float() for part in (*gradients, details)))
        self.optimizer.gradient.copy_(sums[: -len(details)])
        if self.max_norm < math.inf:  # as in torch.nn.utils.clip_grad_norm_
            self.optimizer.gradient *= (self.max_norm / (self.optimizer.gradient.norm() + 1e-6)).clamp(max=1.0)
        self.optimizer.step()
        return sums[-len(details) :]
