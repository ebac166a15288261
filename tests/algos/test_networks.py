from typing import get_args

import pytest
import torch
from conftest import SharedEnv

import lyceum_warp as lw
from lyceum_warp.algos.networks import Activation, Normalizer, mlp


@pytest.mark.parametrize("name", get_args(Activation))
def test_only_hidden_layers_are_followed_by_an_activation(name: Activation) -> None:
    network, obs = mlp([3, 5, 4, 2], activation=name), torch.randn(7, 3)
    function = getattr(torch.nn.functional, name) if name != "tanh" else torch.tanh
    expected = obs
    for i, linear in enumerate(network[::2]):
        expected = torch.nn.functional.linear(expected if i == 0 else function(expected), linear.weight, linear.bias)
    torch.testing.assert_close(network(obs), expected)


def test_unknown_activation_raises_an_error_that_names_it() -> None:
    for network in (lw.GaussianPolicy, lw.TwinCritic):
        with pytest.raises(ValueError, match="^activation must be 'tanh', .* not 'sin'$"):
            network(2, 1, activation="sin")


def test_policy_and_value_function_can_have_different_activations(shared_env: SharedEnv) -> None:
    config = lw.NPGConfig(hidden=(8,), activation="elu", value_hidden=(8,), value_activation="relu")
    npg = lw.NPG(shared_env("point_mass", nworld=2), config=config)
    assert isinstance(npg.policy.network[1], torch.nn.ELU) and isinstance(npg.value.network[1], torch.nn.ReLU)


def test_normalizer_has_the_mean_and_variance_over_all_batches() -> None:
    obs = torch.randn(1000, 4) * torch.tensor([1.0, 10.0, 0.1, 3.0]) + torch.tensor([0.0, 5.0, -2.0, 100.0])
    normalizer = Normalizer(4)
    torch.testing.assert_close(normalizer(obs[:5, :1].expand(5, 4)), obs[:5, :1].expand(5, 4).clamp(-10, 10))
    for part in obs.split([10, 700, 290]):
        normalizer.update(part)
    normalized = normalizer(obs)
    torch.testing.assert_close(normalized.mean(0), torch.zeros(4), atol=1e-3, rtol=0)
    torch.testing.assert_close(normalized.std(0), torch.ones(4), atol=1e-2, rtol=0)
