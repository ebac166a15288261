"""Networks and the normaliser of observations."""

from functools import partial
from typing import Any, get_args

import pytest
import torch

import lyceum_warp as lw
from lyceum_warp.algos.networks import Activation, Normalizer, mlp, moved


@pytest.mark.parametrize("name", get_args(Activation))
def test_every_activation_follows_the_hidden_layers_alone(name: Activation) -> None:
    network, obs = mlp([3, 5, 4, 2], activation=name), torch.randn(7, 3)
    function = getattr(torch.nn.functional, name) if name != "tanh" else torch.tanh
    expected = obs
    for i, linear in enumerate(network[::2]):
        expected = torch.nn.functional.linear(expected if i == 0 else function(expected), linear.weight, linear.bias)
    torch.testing.assert_close(network(obs), expected)


def test_an_unknown_activation_is_refused_by_name() -> None:
    for module in (lambda: mlp([2, 2, 1], activation="sin"), lambda: lw.GaussianPolicy(2, 1, activation="sin"),
                   lambda: lw.ValueFunction(2, activation="sin")):  # type: ignore[arg-type] # fmt: skip
        with pytest.raises(ValueError, match="^activation must be one of 'tanh', .* not 'sin'$"):
            module()


def test_npg_learns_with_activations_of_policy_and_value_apart() -> None:
    env = lw.make("point_mass", nworld=4, horizon=25)
    config = lw.NPGConfig(samples=200, hidden=(8,), activation="elu", value_hidden=(8,), value_activation="relu")
    npg = lw.NPG(env, config=config)
    assert (npg.policy.shape["activation"], npg.value.shape["activation"]) == ("elu", "relu")
    iteration = next(npg)
    assert iteration.kl == pytest.approx(0.5 * config.delta, rel=0.3)  # the Fisher products are right


def test_normalizer_has_mean_and_variance_of_all_portions_together() -> None:
    obs = torch.randn(1000, 4) * torch.tensor([1.0, 10.0, 0.1, 3.0]) + torch.tensor([0.0, 5.0, -2.0, 100.0])
    normalizer = Normalizer(4)
    torch.testing.assert_close(normalizer(obs[:5, :1].expand(5, 4)), obs[:5, :1].expand(5, 4).clamp(-10, 10))
    for part in obs.split([10, 700, 290]):
        normalizer.update(part)
    normalized = normalizer(obs)
    torch.testing.assert_close(normalized.mean(0), torch.zeros(4), atol=1e-3, rtol=0)
    torch.testing.assert_close(normalized.std(0), torch.ones(4), atol=1e-2, rtol=0)


@pytest.mark.parametrize("kind", ["policy", "value"])
def test_later_statistics_of_observations_do_not_change_the_function(kind: str) -> None:
    torch.manual_seed(0)
    obs = torch.randn(500, 4) * torch.tensor([1.0, 10.0, 0.1, 3.0]) + torch.tensor([0.0, 5.0, -2.0, 100.0])
    if kind == "policy":
        module: Any = lw.GaussianPolicy(4, 2, (8,), normalize=True)
        call = module
    else:
        module = lw.ValueFunction(4, (8,), normalize=True, time_orders=2)
        torch.nn.init.normal_(module.network[-1].weight)
        call = partial(module, step=torch.arange(100.0))
    module.observe(obs[:50])
    before, scale = call(obs[:100]), module.normalizer.scale.clone()
    module.observe(3.0 * obs)
    assert not torch.allclose(module.normalizer.scale, scale, rtol=0.5)
    torch.testing.assert_close(call(obs[:100]), before, rtol=1e-3, atol=1e-3)  # the shift changes by 200: rounding


def test_statistics_stay_the_first_where_no_linear_layer_can_compensate() -> None:
    own = torch.nn.Sequential(torch.nn.Tanh(), torch.nn.Linear(4, 2))
    policy = lw.GaussianPolicy(4, 2, network=own, normalize=True)
    policy.observe(torch.randn(50, 4))
    before = policy(torch.ones(1, 4))
    policy.observe(5.0 + torch.randn(50, 4))
    assert torch.equal(policy(torch.ones(1, 4)), before)


def test_a_module_on_the_right_device_is_not_copied() -> None:
    policy = lw.GaussianPolicy(6, 2)
    assert moved(policy, lw.make("point_mass")) is policy
