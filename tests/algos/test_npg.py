import copy
import dataclasses
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from full_task import Full

import lyceum_warp as lw
from lyceum_warp.algos.common.dense import DensePasses
from lyceum_warp.algos.npg import NPGIteration

SMALL = lw.NPGConfig(samples=320, hidden=(8, 8), value_hidden=(16,), mean_every=2, mean_episodes=2)


@pytest.fixture(scope="module")
def env() -> lw.Env:
    return lw.make("point_mass", nworld=16, horizon=12, nthread=1)


def test_policy_step_has_a_kl_divergence_of_half_delta(env: lw.Env) -> None:
    env.rand_reset(0)
    npg = lw.NPG(env, config=dataclasses.replace(SMALL, samples=3200, delta=1e-3, normalize=False), seed=0)
    before = torch.cat([p.detach().flatten() for p in npg.policy.parameters()])
    it = next(npg)
    after = torch.cat([p.detach().flatten() for p in npg.policy.parameters()])
    # KL = step.F.step / 2 to second order
    assert it.kl == pytest.approx(0.0005, rel=0.1)
    assert (after - before).norm().item() == pytest.approx(it.step_norm, rel=1e-4)


def disturbed(npg: lw.NPG, change: Callable[[lw.Rollout, int], object]) -> lw.NPG:
    """Call ``change`` on the samples of each iteration, with the iteration's number."""
    collect = npg.rollout.collect

    def changed(policy: lw.GaussianPolicy, noise: torch.Tensor) -> None:
        collect(policy, noise)
        change(npg.rollout, npg.iteration + 1)

    npg.rollout.collect = changed  # type: ignore[method-assign]
    return npg


def learned(env: lw.Env, iterations: int, change: Callable[[lw.Rollout, int], object]) -> list[NPGIteration]:
    env.rand_reset(3)
    config = dataclasses.replace(SMALL, value_epochs=20, value_rate=1e-2, mean_every=0)
    npg = disturbed(lw.NPG(env, config=config, seed=0), change)
    return [next(npg) for _ in range(iterations)]


def test_learning_does_not_depend_on_the_scale_of_rewards(env: lw.Env) -> None:
    plain = learned(env, 5, lambda *_: None)
    for exponent in (-14, 14):  # multiplying by a power of two causes no rounding errors
        scaled = learned(env, 5, lambda rollout, _, by=2.0**exponent: rollout.reward.mul_(by))  # type: ignore[misc]
        for name in ("return_mean", "explained_variance", "kl", "step_norm"):
            values = [getattr(it, name) for it in scaled]
            assert values == pytest.approx([getattr(it, name) for it in plain], rel=1e-4), (exponent, name)
    assert plain[-1].explained_variance > 0.5


def test_extreme_reward_is_bounded_and_counted(env: lw.Env) -> None:
    def outlier(rollout: lw.Rollout, iteration: int) -> None:
        if iteration == 3:
            rollout.reward[5, 2] = -1e10

    plain, disturbed = learned(env, 8, lambda *_: None), learned(env, 8, outlier)
    assert [it.outliers for it in plain] == [0] * 8
    assert disturbed[2].outliers > 0 and not any(it.outliers for it in (*disturbed[:2], *disturbed[4:]))
    assert disturbed[-1].explained_variance > 0.6 * plain[-1].explained_variance > 0.3
    assert disturbed[-1].step_norm > 0.1 * plain[-1].step_norm

    def first(rollout: lw.Rollout, iteration: int) -> None:
        if iteration == 1:
            rollout.reward[5, 2] = 1e10

    assert learned(env, 6, first)[-1].explained_variance > 0.5


def test_a_step_that_exceeds_the_kl_limit_is_shortened(env: lw.Env) -> None:
    env.rand_reset(0)
    one_sample = dataclasses.replace(SMALL, fisher_fraction=1e-6, delta=0.1, mean_every=0)
    npg = lw.NPG(env, config=one_sample, seed=0)
    iterations = [next(npg) for _ in range(4)]
    assert all(0.0 <= it.kl <= 1.5 * 0.05 + 1e-5 for it in iterations)
    assert min(it.step_fraction for it in iterations) < 0.5
    free = lw.NPG(env, config=dataclasses.replace(one_sample, kl_limit=1e9), seed=0)
    assert max(next(free).kl for _ in range(4)) > 0.2


def test_kl_limit_includes_the_change_of_observation_statistics() -> None:
    env = lw.make("hopper", nworld=16, seed=1, nthread=1)
    config = lw.NPGConfig(samples=1600, hidden=(16,), value_hidden=(16,), mean_every=0, log_std=-2.0)
    npg = disturbed(
        lw.NPG(env, config=config, seed=0), lambda rollout, iteration: rollout.obs.mul_(20.0 if iteration == 4 else 1.0)
    )
    for _ in range(6):
        before, scale = copy.deepcopy(npg.policy), npg.policy.normalizer.scale.clone()
        it = next(npg)
        obs = npg.rollout.obs.flatten(0, 1)
        with torch.no_grad():
            old, new = (
                torch.distributions.Normal(policy(obs), policy.log_std.exp()) for policy in (before, npg.policy)
            )
            kl = torch.distributions.kl_divergence(old, new).sum(-1).mean().item()
        assert it.kl == pytest.approx(kl, rel=1e-3, abs=1e-5) and kl <= 1.5 * 0.05 + 1e-4
        assert not torch.equal(npg.policy.normalizer.scale, scale)


@pytest.mark.parametrize("factor", [1e3, 1e-3])
def test_value_function_follows_a_change_in_the_scale_of_returns(factor: float) -> None:
    value = lw.ValueFunction(3)
    returns = 50.0 + 10.0 * torch.randn(1000, generator=torch.Generator().manual_seed(0))
    value.rescale(returns, first=True)
    assert value.scale.item() == pytest.approx(10.0, rel=0.1)
    for _ in range(4):
        value.rescale(factor * returns)
    assert value.scale.item() == pytest.approx(factor * 10.0, rel=0.1)
    assert value.shift.item() == pytest.approx(factor * 50.0, rel=0.1)


def test_value_function_reads_critic_observations_if_the_task_has_them() -> None:
    env = lw.make(Full, nworld=4)
    npg = lw.NPG(env, config=dataclasses.replace(SMALL, samples=40))
    it = next(npg)
    assert npg.value.group == "critic" and math.isfinite(it.explained_variance)
    assert npg.value.network[0].in_features == env.obs_spaces["critic"].size != env.obs_space.size
    policy_group = lw.NPG(env, config=dataclasses.replace(SMALL, samples=40, value_group="policy"))
    assert policy_group.value.network[0].in_features == env.obs_space.size
    with pytest.raises(ValueError, match="has no group 'privileged' of observations: it has policy, critic"):
        lw.NPG(env, config=dataclasses.replace(SMALL, value_group="privileged"))


def test_rollout_segments_continue_the_previous_episodes(env: lw.Env) -> None:
    env.rand_reset(0)
    npg = lw.NPG(env, config=dataclasses.replace(SMALL, samples=16 * 5, mean_every=0))
    assert npg.segments
    lengths, steps = [], []
    for _ in range(6):
        lengths.append(next(npg).length_mean)
        steps.append(npg.rollout.step.clone())
    joined = torch.cat(steps)
    assert torch.equal(joined, (joined[0] + torch.arange(30.0)[:, None]) % 12)
    assert len(joined[0].unique()) > 5
    # episodes count only if their first steps were sampled
    assert math.isnan(lengths[0])
    assert lengths[-1] == 12.0


@pytest.mark.parametrize(("min_restarts", "begun"), [(None, 1), (2.0, 3), (0.0, 0)])
def test_npg_restarts_worlds_if_too_few_episodes_start(min_restarts: float | None, begun: int) -> None:
    env = lw.make("point_mass", nworld=40, horizon=128)
    config = lw.NPGConfig(samples=40 * 5, hidden=(8,), value_hidden=(8,), mean_every=0, min_restarts=min_restarts)
    npg = lw.NPG(env, config=config)
    npg.rollout.restart()
    next(npg)
    counts = []
    for _ in range(6):
        next(npg)
        assert not npg.rollout.done.any()
        counts.append(int((npg.rollout.step == 0.0).sum()))
    assert counts == [begun] * 6


def test_point_mass_learns_to_reach_the_target() -> None:
    env = lw.make("point_mass", nworld=16)
    config = lw.NPGConfig(
        samples=16 * 256, gamma=0.97, lam=0.95, delta=0.02, hidden=(16, 16), value_hidden=(32, 32), mean_every=0
    )
    npg = lw.NPG(env, config=config, seed=0)
    rewards = [next(npg).terminal_reward for _ in range(25)]
    assert np.mean(rewards[:3]) < 0.4
    assert np.mean(rewards[-3:]) > 0.7, rewards


def test_invalid_npg_arguments_raise_an_error(env: lw.Env) -> None:
    with pytest.raises(ValueError, match=r"env of NPG .* lw.make\(...\) .* 'hopper'"):
        lw.NPG("hopper")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="config of NPG .* NPGConfig .* dict"):
        lw.NPG(env, config={"samples": 3})  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="7 observations.* 'policy' .* 6"):
        lw.NPG(env, value=lw.ValueFunction(7))
    with pytest.raises(ValueError, match="value .* ValueFunction, .* Linear"):
        lw.NPG(env, value=torch.nn.Linear(6, 1))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="'point_mass' .* 'critic'"):
        lw.NPG(env, value=lw.ValueFunction(6, group="critic"))
    broken = lw.ValueFunction(6)
    broken.scale.fill_(math.nan)
    with pytest.raises(ValueError, match="'scale' is not finite"):
        lw.NPG(env, value=broken)


def unnormalized(env: lw.Env, change: Callable[[lw.Rollout, int], object] = lambda *_: None) -> lw.NPG:
    plain = {"mean_every": 0, "normalize": False, "activation": "relu", "value_activation": "relu"}
    return disturbed(lw.NPG(env, config=dataclasses.replace(SMALL, **plain)), change)


def enlarge(rollout: lw.Rollout, iteration: int) -> None:
    rollout.obs[:, 1:, 2] = 1e30


def mean_actions(policy: lw.GaussianPolicy) -> torch.Tensor:
    return policy(torch.linspace(-1.0, 1.0, 30).view(5, 6)).detach()


def parameters(npg: lw.NPG) -> torch.Tensor:
    return torch.cat([p.detach().flatten() for p in (*npg.policy.parameters(), *npg.value.parameters())])


def test_npg_learns_from_the_largest_rewards_that_are_no_faults(env: lw.Env) -> None:
    npg = unnormalized(env, lambda rollout, _: rollout.reward.copy_(9e9 * rollout.obs[..., 0].sign()))
    for it in (next(npg) for _ in range(5)):
        assert not it.skipped_updates and math.isfinite(it.value_error) and it.kl > 1e-6


def test_non_finite_updates_are_skipped_and_counted(env: lw.Env) -> None:
    npg = unnormalized(env, lambda rollout, iteration: iteration % 2 or enlarge(rollout, iteration))
    for iteration in range(1, 7):
        before, spikes = mean_actions(npg.policy), iteration % 2 == 0
        assert next(npg).skipped_updates == (2 if spikes else 0)
        assert torch.equal(mean_actions(npg.policy), before) == spikes
    assert parameters(npg).isfinite().all()


def test_many_consecutive_non_finite_updates_end_a_run(env: lw.Env, tmp_path: Path) -> None:
    npg = unnormalized(env, enlarge)
    before = mean_actions(npg.policy)
    with pytest.raises(FloatingPointError) as raised:
        lw.train(npg, tmp_path / "run", 20)
    message = str(raised.value)
    assert message.startswith("the step of the policy and the fit of the value function in iteration 10 are not finite")
    assert "; the largest observation is 1e+30 in 'velocity' in step 1 of world 1)" in message
    assert raised.value.__notes__[0].startswith(f"the run in {tmp_path / 'run'} is saved up to iteration ")
    assert torch.equal(mean_actions(lw.load(tmp_path / "run")), before)
    assert math.isfinite(next(disturbed(lw.NPG(env, config=SMALL), enlarge)).kl)


def test_value_function_is_restored_after_a_non_finite_update(env: lw.Env) -> None:
    npg = unnormalized(env)
    next(npg)
    good = parameters(npg)[-1].item()
    with torch.no_grad():
        npg.value.network[0].weight[0, 0] = math.nan
    it = next(npg)
    assert (it.skipped_updates, it.faults) == (1, 0) and it.kl > 0.01
    assert parameters(npg).isfinite().all() and parameters(npg)[-1].item() == pytest.approx(good, rel=1e-3)
    assert next(npg).skipped_updates == 0


@pytest.mark.gpu
def test_gpu_iteration_synchronizes_once(monkeypatch: pytest.MonkeyPatch) -> None:
    env = lw.make("hopper", nworld=64, device="cuda")
    options = {"rollout": "segments", "mean_every": 0, "value_batch": 100, "normalize": True, "min_restarts": 2.0}
    npg = lw.NPG(env, config=lw.NPGConfig(samples=64 * 16, **options), seed=1)
    for _ in range(2):  # compile all kernels and capture all graphs
        next(npg)
    copies = []

    def tolist(tensor: torch.Tensor) -> list[list[float]]:
        torch.cuda.set_sync_debug_mode("default")
        copies.append(tensor.shape)
        numbers = tensor.cpu().numpy().tolist()
        torch.cuda.set_sync_debug_mode("error")
        return numbers

    monkeypatch.setattr(torch.Tensor, "tolist", tolist)
    torch.cuda.set_sync_debug_mode("error")
    try:
        it = next(npg)
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert len(copies) == 1 and math.isfinite(it.kl)


def test_optimized_iterations_equal_iterations_with_autograd(monkeypatch: pytest.MonkeyPatch) -> None:
    threads, learned = torch.get_num_threads(), []
    torch.set_num_threads(2)
    try:
        for plain in (False, True):
            env = lw.make("hopper", nworld=8, seed=0, nthread=1)
            # with a KL limit of 1, the line search shortens many steps
            npg = lw.NPG(env, config=lw.NPGConfig(samples=800, mean_every=0, kl_limit=1.0), seed=0)
            if plain:
                monkeypatch.setattr(DensePasses, "of", lambda network: None)
                npg._reads_numbers = False
            it = next(npg)
            learned.append((torch.tensor([it.kl, it.step_fraction]), parameters(npg)))
    finally:
        torch.set_num_threads(threads)
    for part, other in zip(*learned, strict=True):
        torch.testing.assert_close(part, other, rtol=1e-3, atol=1e-5)
