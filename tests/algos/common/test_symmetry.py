import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from conftest import SharedEnv

import lyceum_warp as lw
from lyceum_warp.algos.common.distributed import unflatten
from lyceum_warp.algos.common.symmetry import PolicyMirror, reflections

CONFIG = lw.PPOConfig(hidden=(16,), value_hidden=(16,), num_steps=16, mean_every=2, mean_episodes=2)


@pytest.fixture
def env(shared_env: SharedEnv) -> lw.Env:
    return shared_env("point_mass", nworld=8)


def learner(env: lw.Env, symmetry: str, **changes: Any) -> lw.PPO:
    env.rand_reset(1)
    return lw.PPO(env, config=dataclasses.replace(CONFIG, symmetry=symmetry, **changes), seed=1)


def asymmetry(policy: Callable[[torch.Tensor], torch.Tensor], env: lw.Env) -> float:
    """Return the mean absolute equivariance error of a policy."""
    mirror = PolicyMirror(reflections(env))
    obs = torch.randn(500, env.obs_space.size, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        return (policy(mirror.obs(obs)) - mirror.action(policy(obs))).abs().mean().item()


def test_symmetric_policy_is_equivariant_before_and_after_loading(env: lw.Env, tmp_path: Path) -> None:
    """The normaliser's statistics are not symmetric, but the policy is."""
    ppo = learner(env, "exact")
    run = lw.train(ppo, tmp_path / "run", 2)
    policy = lw.load(run)
    assert policy.normalizer.shift[1].abs() > 1e-3
    assert asymmetry(ppo.policy, env) == asymmetry(policy, env) == 0.0
    assert policy(torch.ones(1, 6)).abs().min() > 0.0 and policy.log_std[0] != policy.log_std[1]
    exported = torch.export.load(lw.export_policy(policy, tmp_path / "policy.pt2")).module()
    obs = torch.randn(9, 6)
    torch.testing.assert_close(exported(obs), policy(obs))
    npg = lw.NPG(env, lw.load(run), config=lw.NPGConfig(samples=512, value_hidden=(8,), mean_every=0))
    next(npg)
    assert asymmetry(npg.policy, env) == 0.0
    continued = lw.PPO(env, lw.load(run), config=CONFIG)
    assert continued.settings()["symmetry"] == "exact"
    next(continued)
    assert asymmetry(continued.policy, env) == 0.0


def test_standard_deviations_of_a_walking_robot_are_symmetric(shared_env: SharedEnv) -> None:
    robot = shared_env("go1_velocity", nworld=4)
    ppo = lw.PPO(robot, config=dataclasses.replace(CONFIG, symmetry="exact", mean_every=0))
    next(ppo)
    right, left = ppo.policy.log_std.view(2, 2, 3).unbind(1)
    assert torch.equal(right, left) and right.unique().numel() == 6
    assert asymmetry(ppo.policy, robot) == 0.0
    augmented = lw.PPO(robot, config=dataclasses.replace(CONFIG, symmetry="augment", mean_every=0))
    assert next(augmented).kl > 0.0 and augmented.value.group == "critic"


def test_mirrored_samples_add_the_mirrored_gradient(env: lw.Env) -> None:
    ppo = learner(env, "augment", hidden=(), value_hidden=(), normalize=False)
    with torch.no_grad():
        for network in (ppo.policy.network, ppo.value.network):
            for parameter in network.parameters():
                parameter.zero_()
    ppo.sample()
    samples = {name: part.flatten(0, 1) for name, part in ppo.evaluated_samples().items()}
    ppo.learn(samples, torch.full((len(samples["obs"]),), 1.0 / len(samples["obs"])))
    weight = unflatten(ppo.optimizer.gradient, ppo._parameters)[1]  # after the standard deviations
    signs = torch.tensor([1.0, -1.0])
    rows, columns = signs, signs.repeat(3)
    assert weight.abs().min() < 1e-6 * weight.abs().max()
    torch.testing.assert_close(weight, weight * rows[:, None] * columns, rtol=0.0, atol=1e-6)


def test_the_learning_rate_ignores_the_asymmetry_of_the_policy(env: lw.Env) -> None:
    """Its KL divergence is the one of metrics.csv, between the old and the new policy on the samples."""
    ppo = learner(env, "augment", desired_kl=1e-9, normalize=False)
    torch.nn.init.xavier_uniform_(ppo.policy.network[-1].weight)
    assert asymmetry(ppo.policy, env) > 0.1
    ppo.sample()
    samples = {name: part.flatten(0, 1) for name, part in ppo.evaluated_samples().items()}
    weight, before = torch.full((len(samples["obs"]),), 1.0 / len(samples["obs"])), ppo.rate.item()
    ppo.learn(samples, weight)
    assert ppo.rate >= before  # the policy has not changed
    ppo._apply_std()
    kl = ppo.divergence()
    ppo.learn(samples, weight)
    assert ppo._sums[-4].item() == pytest.approx(kl.item(), rel=1e-4)
    assert ppo.rate < before


def test_task_without_a_mirror_function_raises_an_error(shared_env: SharedEnv) -> None:
    with pytest.raises(ValueError, match="the task 'hopper' declares no mirror image: set mirror = lw.Mirror"):
        lw.PPO(shared_env("hopper"), config=dataclasses.replace(CONFIG, symmetry="exact"))


@pytest.mark.quick("exact", "augment")
@pytest.mark.parametrize("symmetry", ["exact", "loss", "augment"])
def test_symmetric_policies_stay_symmetric_under_sac(symmetry: str, env: lw.Env, tmp_path: Path) -> None:
    config = lw.SACConfig(
        hidden=(16,), value_hidden=(16,), batch=64, warmup=64, num_steps=40, updates=4, mean_every=0, symmetry=symmetry
    )
    env.rand_reset(1)
    sac = lw.SAC(env, config=config, seed=1)
    before = asymmetry(sac.policy.act, env)
    policy = lw.load(lw.train(sac, tmp_path / "run", 2))
    assert asymmetry(policy.act, env) == asymmetry(sac.policy.act, env)
    if symmetry == "exact":
        # the scaling of actions causes rounding errors
        assert max(before, asymmetry(policy.act, env)) < 1e-6
        assert lw.SAC(env, lw.load(tmp_path / "run"), config=lw.SACConfig(batch=64)).config.symmetry == "exact"
    else:
        assert asymmetry(policy.act, env) < before


def test_asymmetric_action_bounds_raise_an_error() -> None:
    with pytest.raises(ValueError, match="have different bounds than their mirror images"):
        lw.SquashedPolicy(1, 1, (4,), low=[-1.0], high=[2.0], mirror={"obs": ([0], [-1.0]), "action": ([0], [-1.0])})
