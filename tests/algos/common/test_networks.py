import math
from pathlib import Path
from typing import get_args

import pytest
import torch
from conftest import SharedEnv

import lyceum_warp as lw
from lyceum_warp.algos.common.networks import Activation, Normalizer, mlp
from lyceum_warp.training import Run
from lyceum_warp.training.runs.checkpoints import policy_content


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


def test_normalizer_clips_no_ordinary_observations() -> None:
    """The columns have a large mean, a tiny scale, and values that are constant or small at first."""
    generator = torch.Generator().manual_seed(0)
    obs = torch.randn(300, 64, 4, generator=generator).double() * torch.tensor([1.0, 1e-6, 5.0, 20.0])
    obs[..., 0] += 1e6
    obs[:100, :, 2] = 0.0
    obs[:5, :, 3] *= 1e-4
    normalizer = Normalizer(4)
    for batch in obs:
        normalizer.update(batch)
    torch.testing.assert_close(normalizer.mean, obs.mean((0, 1)), rtol=1e-9, atol=1e-12)
    torch.testing.assert_close((normalizer.square / normalizer.count).sqrt(), obs.std((0, 1), correction=0))


@pytest.mark.parametrize("extreme", [1e6, -9e9])
@pytest.mark.parametrize("batch", [8, 64, 20_000])
def test_rare_extreme_observations_hardly_change_the_scale(batch: int, extreme: float) -> None:
    """One of 20,000 observations is extreme, the second one and four more."""
    obs = torch.randn(100_000, 1, generator=torch.Generator().manual_seed(0)).double()
    plain, disturbed = Normalizer(1), Normalizer(1)
    spoilt = obs.clone()
    spoilt[1::20_000] = extreme
    for part, other in zip(obs[:20_000].split(batch), spoilt[:20_000].split(batch), strict=True):
        plain.update(part), disturbed.update(other)
    for part, other in zip(obs[20_000:].split(20_000), spoilt[20_000:].split(20_000), strict=True):
        plain.update(part), disturbed.update(other)
    assert 0.5 < disturbed.scale / plain.scale < 1.0 and (disturbed.shift - plain.shift).abs() < 0.02


def test_normalizer_follows_frequent_observations_of_any_scale() -> None:
    """A column that was constant becomes large in one of 64 worlds."""
    normalizer, obs = Normalizer(1), torch.zeros(64, 1)
    for _ in range(100):
        normalizer.update(obs)
    obs[0] = 1e6
    for _ in range(300):
        normalizer.update(obs)
    assert 1.0 / normalizer.scale.item() == pytest.approx(1e6 / 8.0, rel=0.2)


def test_resumed_normalizer_equals_an_uninterrupted_one() -> None:
    obs = torch.randn(4, 64, 2, generator=torch.Generator().manual_seed(0))
    obs[:, 0] = 1e6
    one, other = Normalizer(2), Normalizer(2)
    one.update(obs[0])
    other.update(100.0 * obs[1])
    other.load_state_dict(one.state_dict())
    for part in obs[2:]:
        one.update(part), other.update(part)
    assert torch.equal(one.scale, other.scale) and torch.equal(one.shift, other.shift)
    other.load_state_dict(Normalizer(2).state_dict())
    other.update(obs[0] + 1e9)  # the first batch of an empty normaliser
    assert other.shift.min() > 9e8


def test_samples_and_log_density_equal_those_of_torch() -> None:
    policy = lw.GaussianPolicy(5, 2, (6, 4), log_std=0.3)
    torch.nn.init.normal_(policy.network[-1].weight)
    obs, noise = torch.randn(20, 5), torch.randn(20, 2)
    normal = torch.distributions.Normal(policy.network(obs), math.exp(0.3))
    action = policy.sample(obs, noise, out=torch.empty(20, 2))
    torch.testing.assert_close(action, normal.mean + normal.stddev * noise)
    torch.testing.assert_close(policy.log_prob(obs, action), normal.log_prob(action).sum(-1))


def test_value_function_has_the_discount_factor_of_its_training(tmp_path: Path) -> None:
    env = lw.make("point_mass", nworld=2, horizon=12)
    config = lw.NPGConfig(samples=24, gamma=0.9)
    value = lw.ValueFunction(env.obs_space.size, (4,))
    assert value.discount is None
    npg = lw.NPG(env, value=value, config=config)
    assert value.discount == lw.NPG(env, config=config).value.discount == 0.9
    run = Run.create(tmp_path, {})
    run.save(policy_content(0, npg.policy, value), {})
    assert lw.load_value(run).discount == 0.9
    content = torch.load(run.policy)
    del content["value"]["shape"]["discount"]  # earlier releases did not save the discount
    torch.save(content, run.policy)
    assert lw.load_value(run).discount is None
    run.save(policy_content(0, npg.policy, lw.ValueFunction(3, (4,), group="critic")), {})
    assert lw.load_value(run).group == "critic"


def test_time_features_are_powers_of_the_step() -> None:
    value = lw.ValueFunction(2, (4,), time_orders=3)
    features = value.features(torch.zeros(1, 2), torch.tensor([500.0]))
    torch.testing.assert_close(features, torch.tensor([[0.0, 0.0, 0.5, 0.25, 0.125]]))
