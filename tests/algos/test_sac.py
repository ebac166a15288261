import copy
import dataclasses
import math
from pathlib import Path
from typing import Any

import pytest
import torch
from conftest import SharedEnv
from metered_task import Metered

import lyceum_warp as lw
from lyceum_warp.algos.common.distributed import unflatten
from lyceum_warp.algos.common.networks import Normalizer

SMALL = lw.SACConfig(
    hidden=(8,), value_hidden=(8, 8), num_steps=12, warmup=60, updates=2, batch=16, replay=78, mean_every=2,
    mean_episodes=2,
)  # fmt: skip


@pytest.fixture
def env(shared_env: SharedEnv) -> lw.Env:
    return shared_env(Metered, nworld=4, horizon=10, far=0.3)


def made(env: lw.Env, *, seed: int = 0, **changes: Any) -> lw.SAC:
    return lw.SAC(env, config=dataclasses.replace(SMALL, **changes), seed=seed)


def test_sac_learns_for_a_fixed_seed(shared_env: SharedEnv) -> None:
    config = lw.SACConfig(
        hidden=(32, 32), value_hidden=(32, 32), num_steps=50, warmup=300, updates=4, batch=128, n_step=3,
        learning_rate=1e-3, temperature=0.1, tau=0.02, gamma=0.97, mean_every=4, mean_episodes=4,
    )  # fmt: skip
    sac = lw.SAC(shared_env("inverted_pendulum", nworld=8, horizon=200), config=config)
    rows = [next(sac) for _ in range(4)]
    assert rows[0].return_mean is not None and rows[0].return_mean < 10.0
    assert rows[-1].return_mean is not None and rows[-1].return_mean > 30.0
    assert rows[-1].mean_return is not None and rows[-1].mean_return > 25.0
    assert rows[-1].samples == 4 * 50 * 8 and rows[-1].temperature < 0.1


class Plain(torch.nn.Module):
    """Compute one of the twin critics in torch and float64."""

    def __init__(self, twin: lw.TwinCritic, k: int) -> None:
        super().__init__()
        weights = [p.detach()[k].double().clone().requires_grad_(True) for p in twin.network.parameters()]
        self.w = torch.nn.ParameterList(weights)
        self.shift, self.scale = twin.normalizer.shift.double(), twin.normalizer.scale.double()

    def forward(self, obs: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        x = torch.cat([((obs - self.shift) * self.scale).clamp(-10.0, 10.0), action], dim=-1)
        for i in range(0, 8, 4):
            weight, bias, gain, shift = self.w[i : i + 4]
            x = x @ weight + bias
            x = (x - x.mean(-1, keepdim=True)) / (x.var(-1, correction=0, keepdim=True) + 1e-5).sqrt()
            x = torch.relu(x * gain + shift)
        quantiles: torch.Tensor = x @ self.w[8] + self.w[9]
        return quantiles


def quantile_huber(quantiles: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """Compute the quantile Huber loss with plain loops."""
    (rows, n), losses = quantiles.shape, []
    for row in range(rows):
        for i in range(n):
            for y in target[row]:
                error, tau = y - quantiles[row, i], (2 * i + 1) / (2 * n)
                huber = error**2 / 2 if error.abs() <= 1 else error.abs() - 0.5
                losses.append(abs(tau - float(error < 0)) * huber)
    return torch.stack(losses).mean()


@pytest.mark.parametrize("changes", [
    {"quantiles": 1}, {"quantiles": 1, "n_step": 3, "critic_bound": "mean"},
    {"quantiles": 5, "dropped_quantiles": 1},
])  # fmt: skip
def test_sac_update_equals_plain_torch_in_float64(changes: dict[str, Any], env: lw.Env) -> None:
    sac = made(env, target_entropy=-0.7, temperature=0.3, updates=1, **changes)
    for _ in range(2):
        next(sac)
    with torch.no_grad():
        for p in sac.target.parameters():
            p += 0.05
    sac.draw()
    nact, config = 1, sac.config
    batch = sac.replay.at(sac._index[0], n_step=config.n_step, gamma=config.gamma)
    assert (batch.discount == 0.0).any()
    next_noise, noise = sac._noise[0].double().split(nact, dim=-1)
    critics, targets = ([Plain(twin, k) for k in range(2)] for twin in (sac.value, sac.target))
    actor = copy.deepcopy(sac.policy).double()
    alpha = sac.log_temperature.detach().double().exp()

    def drawn(obs: torch.Tensor, noise: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        mean, log_std = actor(obs.double())
        u = torch.distributions.Normal(mean, log_std.exp())
        value = mean + log_std.exp() * noise
        log_prob = u.log_prob(value) - torch.log(1.0 - torch.tanh(value) ** 2)
        return torch.tanh(value), log_prob.sum(-1)

    def bound(pair: list[Plain], obs: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        one, two = (critic(obs.double(), action).mean(-1) for critic in pair)
        least = config.quantiles == 1 and config.critic_bound == "min"
        return torch.minimum(one, two) if least else (one + two) / 2

    with torch.no_grad():
        action, log_prob = drawn(batch.next_obs["policy"], next_noise)
        if config.quantiles == 1:
            values = bound(targets, batch.next_obs["critic"], action)[:, None]
        else:
            both = [critic(batch.next_obs["critic"].double(), action) for critic in targets]
            values = torch.cat(both, dim=-1).sort().values[:, :-2]
        value = values - (alpha * log_prob)[:, None]
        target = batch.reward.double()[:, None] + batch.discount.double()[:, None] * value
    unit = 2.0 * (batch.action.double() + 1.0) / 2.0 - 1.0  # the bounds of the actions are -1 and 1
    predicted = [critic(batch.obs["critic"].double(), unit) for critic in critics]
    if config.quantiles == 1:
        loss = sum((values - target).square().mean() for values in predicted)
    else:
        loss = sum(quantile_huber(values, target) for values in predicted)
    step = torch.optim.Adam([p for critic in critics for p in critic.parameters()], lr=config.learning_rate)
    for k, critic in enumerate(critics):
        for i, own in enumerate(critic.parameters()):
            saved = sac.critic_step.optimizer.state_dict()["state"][i]
            step.state[own] = {"step": saved["step"].clone()} | {
                name: saved[name][k].double().clone() for name in ("exp_avg", "exp_avg_sq")
            }
    loss.backward()
    step.step()
    action, log_prob = drawn(batch.obs["policy"], noise)
    actor_loss = (alpha * log_prob - bound(critics, batch.obs["critic"], action)).mean()
    gradients = torch.autograd.grad(actor_loss, list(actor.parameters()))
    before = [p.detach().clone() for p in sac.target.parameters()]

    sac._sums.zero_()
    sac.learn()
    assert sac._sums[0].item() == pytest.approx(loss.item(), rel=1e-4)
    assert sac._sums[2].item() == pytest.approx(actor_loss.item(), rel=1e-4, abs=1e-5)
    assert sac._sums[3].item() == pytest.approx(-log_prob.mean().item(), rel=1e-4)
    for k, critic in enumerate(critics):
        for own, p in zip(critic.parameters(), sac.value.network.parameters(), strict=True):
            torch.testing.assert_close(p.detach()[k].double(), own.detach(), rtol=1e-4, atol=2e-6)
    parts = unflatten(sac.actor_step.optimizer.gradient, gradients)
    for part, gradient in zip(parts, gradients, strict=True):
        torch.testing.assert_close(part.double(), gradient, rtol=1e-3, atol=1e-6)
    assert sac.temperature_step.optimizer.gradient.item() == pytest.approx(-log_prob.mean().item() + 0.7, rel=1e-4)
    for old, new, p in zip(before, sac.target.parameters(), sac.value.parameters(), strict=True):
        torch.testing.assert_close(new, old + 0.005 * (p - old))


def test_action_density_integrates_to_one() -> None:
    policy = lw.SquashedPolicy(1, 1, (4,), low=[-2.0], high=[3.0], generator=torch.Generator().manual_seed(0))
    obs = torch.ones(20_001, 1)
    mean, log_std = policy(obs[:1])
    u = torch.linspace(-8.0, 8.0, 20_001).unsqueeze(-1)
    unit, log_prob = policy.sample(obs, (u - mean) / log_std.exp())
    total = torch.trapezoid(log_prob.detach().exp(), unit.detach().squeeze(-1))
    assert total.item() == pytest.approx(1.0, abs=1e-3)
    action = policy.scaled(unit)
    assert action.min() >= -2.0 and action.max() <= 3.0
    torch.testing.assert_close(policy.unit(action), unit, atol=1e-5, rtol=0.0)


def test_run_contains_policy_critics_and_replay_buffer(env: lw.Env, tmp_path: Path) -> None:
    run = lw.train(made(env), tmp_path / "run", 2)
    assert run.config["algorithm"] == "sac"
    assert run.config["sac"]["replay"] == 78  # as given, although the buffer has room for 20 steps of 4 worlds
    policy, value = lw.load(run, which="best"), lw.load_value(run)
    assert isinstance(policy, lw.SquashedPolicy) and value.group == "critic"
    assert policy.act(torch.full((5, 1), 1e3)).abs().max() <= 1.0
    exported = torch.export.load(lw.export_policy(policy, tmp_path / "policy.pt2")).module()
    obs = torch.linspace(-1.0, 1.0, 5).unsqueeze(-1)
    torch.testing.assert_close(exported(obs), policy.act(obs))
    min((run.folder / "replay").iterdir()).unlink()
    with pytest.raises(ValueError, match="lacks steps 4 to .* of the replay buffer"):
        lw.train(made(env), run, 3)


def test_training_continues_from_given_networks(env: lw.Env) -> None:
    sac = made(env)
    for _ in range(2):
        next(sac)
    policy, value = copy.deepcopy(sac.policy), copy.deepcopy(sac.value)
    for module in (policy, value):
        module.requires_grad_(False)
    other = lw.SAC(env, policy, value, dataclasses.replace(SMALL, hidden=(4,)))
    assert other.config.hidden == (8,)
    assert not math.isnan([next(other) for _ in range(2)][-1].critic_loss)
    assert not torch.equal(policy.network[0].weight, sac.policy.network[0].weight)
    assert (other.replay.action[:4].abs() < 1.0).all()
    npg = lw.NPG(env, config=lw.NPGConfig(samples=80, hidden=(8,), value_hidden=(8,), mean_every=0))
    with pytest.raises(ValueError, match="policy of SAC .* SquashedPolicy.* GaussianPolicy"):
        lw.SAC(env, npg.policy)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="value .* ValueFunction.* TwinCritic"):
        lw.PPO(env, value=value)  # type: ignore[arg-type]
    wide = lw.SquashedPolicy(1, 1, (8,), low=[-2.0], high=[2.0])
    with pytest.raises(
        ValueError, match=r"actions are from \[-2.0\] to \[2.0\], but actions of the task 'metered' are from"
    ):
        lw.SAC(env, wide)
    with pytest.raises(
        ValueError,
        match="the value function is made for 1 observations and 1 actions, .* has 2 obs",
    ):
        lw.SAC(env, value=lw.TwinCritic(1, 1, group="critic"))


def test_unbounded_actions_get_the_default_limit(shared_env: SharedEnv) -> None:
    env = shared_env("go1_velocity", nworld=2)
    sac = lw.SAC(env, config=dataclasses.replace(SMALL, action_limit=1.5, num_steps=3))
    next(sac)
    assert sac.policy.shape["low"] == 12 * [-1.5] and 1.0 < sac.replay.action.abs().max() < 1.5
    assert sac.value.group == "critic" and sac.value.shape["nobs"] == env.obs_spaces["critic"].size


def test_every_step_updates_the_statistics_of_observations(env: lw.Env) -> None:
    sac = made(env)
    next(sac)
    for module, group in ((sac.policy, "policy"), (sac.value, "critic")):
        normalizer = module.normalizer
        assert isinstance(normalizer, Normalizer) and normalizer.count == 48
        obs = torch.cat([sac.replay.obs[group][1:12].flatten(0, 1), env.obs_groups[group]]).double()
        torch.testing.assert_close(normalizer.mean, obs.mean(0))
    assert sac.target.normalizer is sac.value.normalizer


def test_non_finite_update_ends_learning(env: lw.Env) -> None:
    sac = made(env, learning_rate=1e30)
    assert math.isnan(next(sac).critic_loss)  # the first iteration is a warm-up, without updates
    with pytest.raises(FloatingPointError, match="the update of iteration 2 is not finite: make learning_rate, or"):
        next(sac)


def test_defaults_depend_on_the_number_of_worlds() -> None:
    few, many = lw.SACConfig().resolved(8), lw.SACConfig().resolved(4096)
    assert (few.updates, few.batch, few.num_steps, few.warmup, few.gamma) == (8, 256, 125, 5_000, 0.99)
    assert (many.updates, many.batch, many.num_steps, many.warmup, many.gamma) == (8, 8192, 50, 40_960, 0.97)
    assert lw.SACConfig().resolved(1).updates == 1 and lw.SACConfig(gamma=0.9).resolved(4096).gamma == 0.9


def test_hyperparameters_that_contradict_each_other_raise_an_error() -> None:
    with pytest.raises(ValueError, match="updates=6 must be a multiple of actor_every, which is 4"):
        lw.SACConfig(updates=6).resolved(4096)
    with pytest.raises(ValueError, match="dropped_quantiles=3 must be less than quantiles, which is 3"):
        lw.SACConfig(quantiles=3, dropped_quantiles=3)
