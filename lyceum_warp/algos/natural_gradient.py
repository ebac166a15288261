"""The natural gradient's linear system: products with the Fisher information, and conjugate gradient."""

from collections.abc import Callable, Iterable

import torch

from lyceum_warp.algos.distributed import Team
from lyceum_warp.algos.policy import GaussianPolicy


class FisherProduct:
    """Products with the Fisher information of a Gaussian policy, averaged over observations.

    For N(mean(s; theta), diag(sigma^2)) it is E[J^T diag(1 / sigma^2) J] for the parameters of the mean, with
    J = d mean / d theta, and 2 for each log sigma. J v is the derivative of the linear map u -> J^T u, so both
    factors are backward passes through graphs that are built once.

    Args:
        policy: The policy.
        obs: Observations, (samples, nobs).
        damping: Added to the diagonal.
        count: Number of observations of all processes; by default those in ``obs``.
        weight: Weights of the observations, (samples,): 1, or 0 for one that another process brings.
        team: The processes.
    """

    def __init__(
        self,
        policy: GaussianPolicy,
        obs: torch.Tensor,
        damping: float,
        *,
        count: int | None = None,
        weight: torch.Tensor | None = None,
        team: Team | None = None,
    ) -> None:
        self.parameters = [p for p in policy.parameters() if p.requires_grad]
        self.log_std_at = next((i for i, p in enumerate(self.parameters) if p is policy.log_std), None)
        self.network = [p for p in self.parameters if p is not policy.log_std]
        self.precision = torch.exp(-2 * policy.log_std.detach()) / (count or len(obs))
        if weight is not None:
            self.precision = weight.unsqueeze(-1) * self.precision
        self.damping, self.team = damping, team or Team()
        self.mean = policy(obs)
        self.probe = torch.zeros_like(self.mean, requires_grad=True)
        self.pulled = torch.autograd.grad(self.mean, self.network, self.probe, create_graph=True)

    def __call__(self, vector: torch.Tensor) -> torch.Tensor:
        """(F + damping) vector, both (parameters,)."""
        parts = [
            part.view_as(p)
            for part, p in zip(vector.split([p.numel() for p in self.parameters]), self.parameters, strict=True)
        ]
        log_std_part = vector if self.log_std_at is None else parts.pop(self.log_std_at)
        (pushed,) = torch.autograd.grad(self.pulled, self.probe, parts, retain_graph=True)
        pulled = list(torch.autograd.grad(self.mean, self.network, pushed * self.precision, retain_graph=True))
        if self.log_std_at is not None:  # not a sum over samples: each process contributes an equal part
            pulled.insert(self.log_std_at, 2.0 / self.team.size * log_std_part)
        return self.team.sum(flatten(pulled)) + self.damping * vector


def conjugate_gradient(
    product: Callable[[torch.Tensor], torch.Tensor], target: torch.Tensor, iterations: int
) -> torch.Tensor:
    """Solve product(x) = target for a symmetric positive definite product, from x = 0.

    The number of iterations is fixed and no decision depends on a number, so nothing waits for the device. Once the
    residual vanishes the steps are zero.
    """
    x = torch.zeros_like(target)
    residual = target.clone()
    direction = target.clone()
    square = residual @ residual
    for _ in range(iterations):
        image = product(direction)
        curvature = direction @ image
        alpha = (square / curvature).masked_fill(~(curvature > 0), 0.0)
        x += alpha * direction
        residual -= alpha * image
        previous, square = square, residual @ residual
        direction = residual + (square / previous).masked_fill(~(previous > 0), 0.0) * direction
    return x


def flatten(tensors: Iterable[torch.Tensor]) -> torch.Tensor:
    """The numbers of several tensors as one vector."""
    return torch.cat([tensor.reshape(-1) for tensor in tensors])
