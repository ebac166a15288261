"""Compute the vanilla policy gradient, and solve for the natural gradient by conjugate gradient."""

from collections.abc import Callable, Iterable, Sequence

import torch

from lyceum_warp.algos.common.dense import DensePolicy
from lyceum_warp.algos.common.distributed import Team, flatten, unflatten
from lyceum_warp.algos.common.policy import GaussianPolicy


def score_gradient(
    policy: GaussianPolicy, obs: torch.Tensor, action: torch.Tensor, weight: torch.Tensor
) -> torch.Tensor:
    """Compute the gradient (parameters,) of sum(weight * log pi(action | obs))."""
    parameters = [p for p in policy.parameters() if p.requires_grad]
    if not isinstance(policy, DensePolicy):
        return flatten(torch.autograd.grad((policy.log_prob(obs, action) * weight).sum(), parameters))
    precision = torch.exp(-policy.log_std.detach())
    z, weight = (action - policy(obs)) * precision, weight.unsqueeze(-1)
    gradients = policy.passes.pull(z * precision * weight)
    if (at := _place(policy.log_std, parameters)) is not None:
        gradients.insert(at, ((z.square() - 1.0) * weight).sum(0))
    return flatten(gradients)


class FisherProduct:
    """Multiplies vectors by the Fisher information of a Gaussian policy.

    The Fisher information of N(mean(s; theta), diag(sigma^2)) is averaged over the observations s, and has two blocks.
    The block of theta is E[J^T diag(1/sigma^2) J] with J = d mean / d theta. The block of log sigma is twice the
    identity matrix.

    ``count`` is the number of observations of all processes. ``weight`` is 0 for observations of other processes, and
    otherwise 1.
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
        self.log_std_at = _place(policy.log_std, self.parameters)
        self.precision = torch.exp(-2 * policy.log_std.detach()) / (count or len(obs))
        if weight is not None:
            self.precision = weight.unsqueeze(-1) * self.precision
        self.damping, self.team = damping, team or Team()
        self.mean = policy(obs)
        network = [p for p in self.parameters if p is not policy.log_std]
        dense = policy.passes if isinstance(policy, DensePolicy) else None
        self.jacobian = dense or AutogradJacobian(self.mean, network)

    def __call__(self, vector: torch.Tensor) -> torch.Tensor:
        """Compute (F + damping I) v, (parameters,)."""
        parts = unflatten(vector, self.parameters)
        log_std_part = vector if self.log_std_at is None else parts.pop(self.log_std_at)
        pulled = self.jacobian.pull(self.jacobian.push(parts) * self.precision)
        if self.log_std_at is not None:
            # this term is not a sum over samples, so each process adds an equal share
            pulled.insert(self.log_std_at, 2.0 / self.team.size * log_std_part)
        return self.team.sum(flatten(pulled)) + self.damping * vector


class AutogradJacobian:
    """Compute products with a network's Jacobian J = d mean / d parameters by autograd.

    A backward pass through the network computes u^T J. J v is the derivative of u^T J v with respect to u, so a
    backward pass through the first backward pass computes J v.
    """

    def __init__(self, mean: torch.Tensor, parameters: Sequence[torch.Tensor]) -> None:
        self.mean, self.parameters = mean, parameters
        self.probe = torch.zeros_like(mean, requires_grad=True)
        self.pulled = torch.autograd.grad(mean, parameters, self.probe, create_graph=True)

    def push(self, parts: Sequence[torch.Tensor]) -> torch.Tensor:
        """Compute J v, (samples, nact); v has one tensor for each parameter."""
        return torch.autograd.grad(self.pulled, self.probe, parts, retain_graph=True)[0]

    def pull(self, u: torch.Tensor) -> list[torch.Tensor]:
        """Compute J^T u for u (samples, nact); the result has one tensor for each parameter."""
        return list(torch.autograd.grad(self.mean, self.parameters, u, retain_graph=True))


def conjugate_gradient(
    product: Callable[[torch.Tensor], torch.Tensor], target: torch.Tensor, iterations: int
) -> torch.Tensor:
    """Solve A x = target for a symmetric positive definite matrix A, starting from x = 0; ``product`` computes A x.

    No branch depends on the value of a tensor, so the host never waits for the device.
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


def _place(tensor: torch.Tensor, tensors: Iterable[torch.Tensor]) -> int | None:
    return next((i for i, other in enumerate(tensors) if other is tensor), None)
