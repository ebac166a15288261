from typing import get_args

import pytest
import torch

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
    for module in (lambda: mlp([2, 2, 1], activation="sin"), lambda: lw.GaussianPolicy(2, 1, activation="sin"),
                   lambda: lw.ValueFunction(2, activation="sin")):  # type: ignore[arg-type] # fmt: skip
        with pytest.raises(ValueError, match="^activation must be 'tanh', .* not 'sin'$"):
            module()


def test_npg_learns_with_different_activations_of_policy_and_value() -> None:
    env = lw.make("point_mass", nworld=4, horizon=25)
    config = lw.NPGConfig(samples=200, hidden=(8,), activation="elu", value_hidden=(8,), value_activation="relu")
    npg = lw.NPG(env, config=config)
    assert (npg.policy.shape["activation"], npg.value.shape["activation"]) == ("elu", "relu")
    iteration = next(npg)
    assert iteration.kl == pytest.approx(0.5 * config.delta, rel=0.3)


def test_normalizer_has_the_mean_and_variance_over_all_batches() -> None:
    obs = torch.randn(1000, 4) * torch.tensor([1.0, 10.0, 0.1, 3.0]) + torch.tensor([0.0, 5.0, -2.0, 100.0])
    normalizer = Normalizer(4)
    torch.testing.assert_close(normalizer(obs[:5, :1].expand(5, 4)), obs[:5, :1].expand(5, 4).clamp(-10, 10))
    for part in obs.split([10, 700, 290]):
        normalizer.update(part)
    normalized = normalizer(obs)
    torch.testing.assert_close(normalized.mean(0), torch.zeros(4), atol=1e-3, rtol=0)
    torch.testing.assert_close(normalized.std(0), torch.ones(4), atol=1e-2, rtol=0)
