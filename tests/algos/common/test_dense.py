import pytest
import torch
from torch import nn

import lyceum_warp as lw
from lyceum_warp.algos.common.dense import DensePasses, dense_policy
from lyceum_warp.algos.natural_gradient import FisherProduct, score_gradient


def perturbed(module: nn.Module) -> nn.Module:
    """Add random numbers to the weights, so that derivatives are not zero."""
    generator = torch.Generator().manual_seed(5)
    with torch.no_grad():
        for parameter in module.parameters():
            parameter.add_(0.3 * torch.randn(parameter.shape, generator=generator))
    return module


def policy_of(activation: str, hidden: tuple[int, ...] = (8, 6), **options: object) -> lw.GaussianPolicy:
    policy = lw.GaussianPolicy(5, 2, hidden, activation=activation, normalize=True, **options)
    policy.observe(3.0 * torch.randn(50, 5, generator=torch.Generator().manual_seed(3)) + 1.0)
    perturbed(policy)
    return policy


@pytest.mark.parametrize("activation", ["tanh", "relu", "elu"])
@pytest.mark.parametrize("hidden", [(), (8,), (8, 6), (3, 16, 4)])
def test_hand_written_derivatives_equal_those_of_autograd(activation: str, hidden: tuple[int, ...]) -> None:
    policy = policy_of(activation, hidden)
    dense = dense_policy(policy)
    assert dense is not policy
    for rows, learned in ((30, True), (7, True), (30, False)):
        policy.log_std.requires_grad_(learned)
        generator = torch.Generator().manual_seed(rows)
        obs, action, weight = (torch.randn(rows, n, generator=generator) for n in (5, 2, 1))
        torch.testing.assert_close(dense(obs), policy(obs).detach())
        weight = weight.squeeze(1)
        gradients = [score_gradient(one, obs, action, weight) for one in (policy, dense)]
        torch.testing.assert_close(*gradients, rtol=1e-4, atol=1e-5)
        vector = torch.randn(len(gradients[0]), generator=generator)
        plain, written = (FisherProduct(one, obs, 0.1, weight=weight.abs()) for one in (policy, dense))
        for direction in (vector, vector.flip(0)):
            torch.testing.assert_close(plain(direction), written(direction), rtol=1e-4, atol=1e-5)


class Own(nn.Sequential):
    """A user's network class."""


def hooked(network: nn.Module) -> nn.Module:
    network[0].register_forward_hook(lambda module, args, output: 2.0 * output)
    return network


SHARED = nn.Linear(5, 5)

OTHERS = {
    "class": lambda: Own(nn.Linear(5, 2)),
    "hook": lambda: hooked(nn.Sequential(nn.Linear(5, 4), nn.Tanh(), nn.Linear(4, 2))),
    "no bias": lambda: nn.Sequential(nn.Linear(5, 4, bias=False), nn.Tanh(), nn.Linear(4, 2)),
    "two activations": lambda: nn.Sequential(nn.Linear(5, 4), nn.Tanh(), nn.Linear(4, 4), nn.ReLU(), nn.Linear(4, 2)),
    "alpha": lambda: nn.Sequential(nn.Linear(5, 4), nn.ELU(0.5), nn.Linear(4, 2)),
    "other activation": lambda: nn.Sequential(nn.Linear(5, 4), nn.GELU(), nn.Linear(4, 2)),
    "norm of weights": lambda: nn.Sequential(
        nn.Linear(5, 4), nn.Tanh(), nn.utils.parametrizations.weight_norm(nn.Linear(4, 2))
    ),
    "shared layer": lambda: nn.Sequential(SHARED, nn.Tanh(), SHARED),
}


@pytest.mark.parametrize("kind", OTHERS)
def test_networks_other_than_the_default_use_autograd(kind: str) -> None:
    assert DensePasses.of(OTHERS[kind]()) is None


def test_policy_subclass_and_frozen_layers_use_autograd() -> None:
    class Policy(lw.GaussianPolicy):
        pass

    own = Policy(5, 2)
    assert dense_policy(own) is own
    policy = policy_of("tanh")
    policy.network[0].requires_grad_(False)
    assert dense_policy(policy) is policy
