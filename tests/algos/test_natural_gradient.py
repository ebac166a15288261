import math

import numpy as np
import torch

import lyceum_warp as lw
from lyceum_warp.algos.natural_gradient import FisherProduct, conjugate_gradient


def test_fisher_product_equals_the_covariance_of_the_score() -> None:
    """The Fisher information is E[score score^T]. Quadrature over each action gives the exact expectation."""
    torch.manual_seed(1)
    policy = lw.GaussianPolicy(5, 2, (6, 4))
    for parameter in policy.parameters():
        parameter.data += 0.3 * torch.randn_like(parameter)
    obs = torch.randn(7, 5)
    size = sum(p.numel() for p in policy.parameters())
    nodes, weights = np.polynomial.hermite_e.hermegauss(6)
    fisher = torch.zeros(size, size)
    for o in obs:
        mean, std = policy(o).detach(), policy.log_std.exp().detach()
        for i, x in enumerate(nodes):
            for j, y in enumerate(nodes):
                action = mean + std * torch.tensor([x, y], dtype=torch.float32)
                grads = torch.autograd.grad(policy.log_prob(o, action), list(policy.parameters()))
                score = torch.cat([g.flatten() for g in grads])
                fisher += weights[i] * weights[j] / (2 * math.pi) / len(obs) * score.outer(score)
    vector = torch.randn(size)
    product = FisherProduct(policy, obs, damping=0.1)
    torch.testing.assert_close(product(vector), fisher @ vector + 0.1 * vector, atol=2e-4, rtol=2e-4)


def test_conjugate_gradient_solves_the_system() -> None:
    generator = torch.Generator().manual_seed(3)
    root = torch.randn(12, 12, generator=generator, dtype=torch.float64)
    matrix, target = root @ root.T + torch.eye(12), torch.randn(12, generator=generator, dtype=torch.float64)
    expected = torch.linalg.solve(matrix, target)
    torch.testing.assert_close(conjugate_gradient(lambda v: matrix @ v, target, 12), expected, rtol=1e-6, atol=1e-8)
    torch.testing.assert_close(conjugate_gradient(lambda v: matrix @ v, target, 40), expected, rtol=1e-6, atol=1e-8)
    zero = torch.zeros_like(target)
    assert torch.equal(conjugate_gradient(lambda v: matrix @ v, zero, 5), zero)
