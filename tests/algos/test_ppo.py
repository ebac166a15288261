import copy
import dataclasses
import math
import re
from typing import Any

import pytest
import torch
from conftest import SharedEnv
from metered_task import Metered

import lyceum_warp as lw
from lyceum_warp.algos.common.networks import Normalizer
from lyceum_warp.support.settings import temporarily

SMALL = lw.PPOConfig(hidden=(8,), value_hidden=(8, 8), num_steps=12, mean_every=2, mean_episodes=2)


@pytest.fixture
def env(shared_env: SharedEnv) -> lw.Env:
    return shared_env(Metered, nworld=4, horizon=10)


def made(env: lw.Env, *, seed: int = 0, **changes: Any) -> lw.PPO:
    return lw.PPO(env, config=dataclasses.replace(SMALL, **changes), seed=seed)


def test_ppo_learns_for_a_fixed_seed() -> None:
    config = lw.PPOConfig(hidden=(32, 32), value_hidden=(32, 32), mean_every=40)
    ppo = lw.PPO(lw.make("point_mass", nworld=32), config=config)
    rows = [next(ppo) for _ in range(40)]
    assert rows[-1].mean_return is not None and rows[-1].mean_return > 150.0
    assert rows[-1].return_recent > rows[15].return_recent + 50.0
    assert rows[-1].samples == 40 * 24 * 32


def test_reported_statistics_equal_the_statistics_of_the_samples(shared_env: SharedEnv) -> None:
    ppo = made(shared_env(Metered, nworld=4, horizon=10, far=1e3))
    found: list[float] = []
    for _ in range(3):
        it, rollout = next(ppo), ppo.rollout
        ended = rollout.episode_return[rollout.done].tolist()
        found += [number for number in ended if number == number]
        assert it.return_recent == pytest.approx(sum(found) / len(found))
    assert it.samples == 3 * 48 == 3 * ppo.count and it.length_mean == 10.0 and it.faults == 0
    assert it.reward_mean == pytest.approx(rollout.reward.mean().item())
    assert it.learning_rate == pytest.approx(ppo.rate.item())
    old = torch.distributions.Normal(ppo._means.double(), ppo._old_log_std.double().exp())
    new = torch.distributions.Normal(ppo.policy(rollout.obs).double(), ppo.policy.log_std.double().exp())
    assert it.kl == pytest.approx(torch.distributions.kl_divergence(old, new).sum(-1).mean().item(), rel=1e-4)


def test_truncated_episode_bootstraps_from_its_final_observation(env: lw.Env) -> None:
    """In step 1, world 0 continues, world 1 reaches its time limit, world 2 has a fault, and world 3 terminates."""
    ppo = made(env, num_steps=3, normalize=False, minibatches=1)
    state = env.get_state()
    for part, column in {"qpos": [0, 0, 0, 5], "qvel": [1, 2, 3, 4], "step": [0, 9, 0, 0]}.items():
        state[:, env.state_space.parts[part].start] = torch.tensor(column, dtype=torch.float64)
    env.set_state(state)
    step = env.step

    def faulty() -> None:
        if env.episode_step[2] == 0 and not ppo.rollout.done.any():
            env.action[2] = torch.nan
        step()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(env, "step", faulty)
        ppo.sample()
    rollout, samples = ppo.rollout, ppo.evaluated_samples()
    assert rollout.done[0].tolist() == [False, True, True, True]
    assert rollout.terminated[0].tolist() == [False, False, False, True]
    final = rollout.final_obs_groups["critic"]
    assert final[0, 2, 1] == 3.0  # after a fault, the final observation is the last finite one
    with torch.no_grad():
        value, after = (ppo.value(obs, rollout.step) for obs in (rollout.obs_groups["critic"], final))
    gamma, lam = SMALL.gamma, SMALL.lam
    expected = torch.zeros(3, 4)
    for world in range(4):
        advantage = 0.0
        for t in (2, 1, 0):
            rest = 0.0 if rollout.terminated[t, world] else after[t, world].item()
            advantage = 0.0 if rollout.done[t, world] else advantage
            change = rollout.reward[t, world].item() + gamma * rest - value[t, world].item()
            advantage = expected[t, world] = change + gamma * lam * advantage
    torch.testing.assert_close(samples["target"] - samples["value"], expected, rtol=1e-4, atol=1e-5)
    whitened = (expected - expected.mean()) / expected.std()
    torch.testing.assert_close(samples["advantage"], whitened, rtol=1e-3, atol=1e-4)


def test_every_step_updates_the_statistics_of_observations(env: lw.Env) -> None:
    ppo, scales = made(env), []
    normalizer = ppo.policy.normalizer
    assert isinstance(normalizer, Normalizer)
    ppo.policy.network.register_forward_pre_hook(lambda *_: scales.append(normalizer.scale.item()))
    ppo.sample()
    assert normalizer.count == 48 and len(set(scales)) == 12
    seen = torch.cat([ppo.rollout.obs[1:], env.obs[None]]).double()
    torch.testing.assert_close(normalizer.mean, seen.mean((0, 1)))
    torch.testing.assert_close(1.0 / normalizer.scale.double(), seen.std((0, 1), correction=0) + 0.01)


def test_networks_do_not_see_how_absurd_an_observation_is(env: lw.Env) -> None:
    ppo = made(env)
    next(ppo)
    obs = torch.tensor([[1e4], [1e9]])
    assert ppo.policy(obs)[0].equal(ppo.policy(obs)[1])
    both = ppo.value.normalizer(obs.repeat(1, 2))
    assert both[0].equal(both[1])


@pytest.mark.parametrize("changes", [{}, {"recurrent": 4, "whiten_minibatches": True}])
def test_threads_change_only_the_rounding_of_updates(changes: dict[str, Any], env: lw.Env) -> None:
    numbers, threads = [], torch.get_num_threads()
    for count in (1, 2):
        env.rand_reset(0)
        with temporarily(torch.set_num_threads, count, threads):
            ppo = made(env, num_steps=128, minibatches=1, mean_every=0, **changes)
            its = [next(ppo) for _ in range(2)]
            assert torch.get_num_threads() == count
        numbers.append([(it.kl, it.value_loss, it.surrogate_loss, it.entropy, it.std_mean) for it in its])
    assert numbers[0] != numbers[1]  # sums of two threads round in another way
    for one, two in zip(*numbers, strict=True):
        assert two == pytest.approx(one, rel=1e-3, abs=1e-6)


@pytest.mark.parametrize("changes, rate", [
    ({"desired_kl": 1e-9}, 1e-5), ({"desired_kl": 1e6}, 1e-2), ({"schedule": "fixed", "desired_kl": 1e-9}, 1e-3),
])  # fmt: skip
def test_the_learning_rate_follows_the_kl_divergence(changes: dict[str, Any], rate: float, env: lw.Env) -> None:
    assert next(made(env, **changes)).learning_rate == pytest.approx(rate)


def test_entropy_weight_decreases_linearly(env: lw.Env) -> None:
    config = lw.PPOConfig(entropy_coef=0.02, final_entropy_coef=0.01, entropy_decay=(10, 20))
    assert [config.entropy_weight(it) for it in (1, 10, 15, 20, 99)] == pytest.approx([0.02, 0.02, 0.015, 0.01, 0.01])
    assert lw.PPOConfig(entropy_coef=0.02).entropy_weight(500) == 0.02
    stds = []
    for final in (0.0, 5.0):
        env.rand_reset(0)
        ppo = made(env, schedule="fixed", entropy_coef=0.0, final_entropy_coef=final, entropy_decay=(1, 3))
        stds.append([next(ppo).std_mean for _ in range(3)])
    assert stds[1][0] == pytest.approx(stds[0][0]) and stds[1][2] > stds[0][2] + 0.02


def test_training_continues_from_given_networks(env: lw.Env) -> None:
    npg = lw.NPG(env, config=lw.NPGConfig(samples=80, hidden=(8,), value_hidden=(8,), time_orders=2, mean_every=0))
    next(npg)
    policy, value = copy.deepcopy(npg.policy).requires_grad_(False), copy.deepcopy(npg.value).requires_grad_(False)
    ppo = lw.PPO(env, policy, value, SMALL)
    assert next(ppo).kl > 0.0
    assert not torch.equal(policy.network[0].weight, npg.policy.network[0].weight)
    assert not torch.equal(value.network[0].weight, npg.value.network[0].weight)
    assert ppo.settings()["activation"] == "tanh" and ppo.settings()["num_steps"] == 12


@pytest.mark.parametrize("entropy_decay", [7, (5, 5)])
def test_invalid_entropy_decay_raises_an_error(entropy_decay: Any) -> None:
    with pytest.raises(ValueError, match=re.escape(f"not {entropy_decay}")):
        lw.PPOConfig(entropy_decay=entropy_decay)


def test_invalid_ppo_arguments_raise_an_error(env: lw.Env) -> None:
    with pytest.raises(ValueError, match="200 mini-batches .* 48: use more worlds or fewer mini-batches"):
        made(env, minibatches=200)
    with pytest.raises(ValueError, match="no group 'actor' .* policy, critic"):
        made(env, value_group="actor")
    with pytest.raises(ValueError, match="seed .* -1"):
        made(env, seed=-1)


def test_mini_batches_that_leave_out_samples_print_a_warning(env: lw.Env, caplog: pytest.LogCaptureFixture) -> None:
    made(env, minibatches=4)
    assert not caplog.messages
    made(env, minibatches=7)
    (message,) = caplog.messages
    assert "42 of 48 samples" in message


def test_non_finite_update_ends_learning_and_names_the_largest_samples(env: lw.Env) -> None:
    ppo = made(env, learning_rate=1e30, schedule="fixed")
    with pytest.raises(FloatingPointError) as raised:
        next(ppo)
    message, rollout = str(raised.value), ppo.rollout
    for name, rows in (("reward", rollout.reward), ("observation", rollout.obs[..., 0])):
        t, world = divmod(int(rows.abs().argmax()), 4)
        found = re.search(rf"largest {name} is (\S+) .*?in step (\d+) of world (\d+)", message)
        assert found is not None and float(found[1]) == pytest.approx(rows[t, world].item(), rel=1e-4)
        assert (int(found[2]), int(found[3])) == (t + 1, world)


def test_ppo_learns_from_the_largest_rewards_that_are_no_faults(env: lw.Env) -> None:
    ppo = made(env)
    estimate = ppo._estimate
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(ppo, "_estimate", lambda reward, *rest: estimate(reward.sign() * 9e9, *rest))
        assert all(math.isfinite(next(ppo).value_loss) for _ in range(3))
