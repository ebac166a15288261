"""Test go1_velocity.

oracles/test_mjlab.py compares its observations, rewards and terminations with those of mjlab.
"""

from collections.abc import Iterator
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from checks import check_uniform
from conftest import SharedEnv

import lyceum_warp as lw

NWORLD, DT, SUBSTEP = 64, 0.02, 0.005
FEET = [f"{leg}_foot" for leg in ("FR", "FL", "RR", "RL")]
HOME = np.array([0.1, 0.9, -1.8, -0.1, 0.9, -1.8] * 2)
NEVER = (1e6, 1e6)
NOISELESS: dict[str, Any] = {
    f"{part}_noise": 0.0
    for part in ("linear_velocity", "angular_velocity", "gravity", "joint_position", "joint_velocity")
}


def state_parts(env: lw.Env) -> dict[str, torch.Tensor]:
    return dict(env.state_space.split(env.get_state()))


def random_steps(env: lw.Env, steps: int) -> Iterator[None]:
    """Step with random actions that are correlated over time."""
    generator, action = torch.Generator().manual_seed(1), torch.zeros(env.nworld, 12)
    for _ in range(steps):
        action = 0.8 * action + 0.6 * torch.randn(env.nworld, 12, generator=generator)
        env.step(action)
        yield


def test_forces_are_zero_until_the_first_substep(shared_env: SharedEnv) -> None:
    env = shared_env("go1_velocity", nworld=NWORLD)
    list(random_steps(env, 20))
    env.rand_reset()
    assert not env.field("sensordata").any() and not env.obs_groups["critic"][:, -12:].any()
    for _ in range(10):
        env.step(torch.zeros(NWORLD, 12))
    assert (env.field("sensordata")[:, 2::3].abs() > 1.0).any(dim=1).float().mean() > 0.9  # the robots stand


def test_policy_observations_have_uniform_noise_and_critic_observations_have_none(shared_env: SharedEnv) -> None:
    env = shared_env("go1_velocity", nworld=1000)
    list(random_steps(env, 2))
    clean = shared_env("go1_velocity", nworld=1000, **NOISELESS)
    clean.set_state(env.get_state())
    noise = (env.obs - clean.obs).numpy()
    assert torch.equal(env.obs_groups["critic"], clean.obs_groups["critic"])
    assert not noise[:, 33:].any()
    sizes = np.repeat([0.5, 0.2, 0.05, 0.01, 1.5], [3, 3, 3, 12, 12])
    check_uniform(noise[:, :33] / (sizes * (1 + 1e-3)))


def test_timers_and_peak_heights_follow_the_contacts_of_the_feet(shared_env: SharedEnv) -> None:
    env = shared_env("go1_velocity", nworld=16, autoreset=False, **NOISELESS, push_seconds=NEVER)
    landings, before = 0, state_parts(env)
    for _ in random_steps(env, 40):
        now, critic = state_parts(env), env.obs_spaces["critic"].split(env.obs_groups["critic"])
        touching = critic["foot_contact"] > 0
        for name, running in (("contact_time", touching), ("air_time", ~touching)):
            assert torch.equal(now[name] > 0, running)
            goes_on = (now[name] - before[name] - DT).abs() < 1e-6
            assert (goes_on | (now[name] < DT + 1e-6))[running].all()
            substeps = now[name] / SUBSTEP
            torch.testing.assert_close(substeps, substeps.round(), atol=1e-3, rtol=0)
        landed = touching & (now["contact_time"] < DT + 1e-6)
        peak = torch.where(touching, before["peak_height"], before["peak_height"].maximum(critic["foot_height"]))
        torch.testing.assert_close(now["peak_height"], torch.where(landed, 0.0, peak), atol=1e-6, rtol=0)
        landings, before = landings + int(landed.sum()), now
    assert landings > 50
    env.rand_reset()
    after = state_parts(env)
    assert torch.equal(after["peak_height"], before["peak_height"]) and after["peak_height"].max() > 0.02
    assert not any(after[name].any() for name in ("contact_time", "air_time", "last_action"))


@pytest.mark.usefixtures("freed")
def test_commands_have_the_distribution_of_mjlab() -> None:
    env = lw.make("go1_velocity", nworld=4000, seed=0)
    parts = {name: part.numpy().squeeze(-1) for name, part in state_parts(env).items() if part.shape[1] == 1}
    vx, vy, yaw = state_parts(env)["drawn_velocity"].numpy().T
    forward = (vy == 0) & (yaw == 0)
    for share, wanted in ((forward, 0.2), (parts["heading_controlled"], 0.3), (parts["standing"], 0.1)):
        assert abs(share.mean() - wanted) < 4 * np.sqrt(wanted * (1 - wanted) / 4000)
    timers = (parts["command_timer"] - 5.5) / 2.5, parts["push_timer"] - 2
    drawn = np.stack([vx, vy, 2 * yaw, parts["heading_target"] / np.pi, *timers], axis=1)
    check_uniform(drawn[~forward] / (1 + 1e-6))
    assert vx[forward].min() == np.float32(0.3) and vx[forward].max() <= 1
    assert abs((vx[forward] == np.float32(0.3)).mean() - 0.3) < 0.07
    flags = np.stack([forward, parts["heading_controlled"], parts["standing"]], axis=1)
    assert np.abs(np.corrcoef(flags.T) - np.eye(3)).max() < 5.5 / np.sqrt(4000)


def test_curriculum_widens_the_command_ranges_at_each_stage() -> None:
    env = lw.make("go1_velocity", nworld=1000, **NOISELESS)
    for steps, low, high, yaw in ((119_998, -1, 1, 0.5), (119_999, -1.5, 2, 0.7), (239_999, -2, 3, 0.7)):
        state = env.get_state()
        parts = env.state_space.split(state)
        parts["env_steps"][:] = steps
        parts["command_timer"][:] = 0.0
        env.set_state(state)
        env.step(torch.zeros(1000, 12))
        drawn = state_parts(env)["drawn_velocity"]
        free = drawn[:, 1] != 0
        for column, bounds in ((0, (low, high)), (2, (-yaw, yaw))):
            values, width = drawn[free, column], bounds[1] - bounds[0]
            assert bounds[0] <= values.min() < bounds[0] + 0.02 * width
            assert bounds[1] >= values.max() > bounds[1] - 0.02 * width


def test_pushes_add_velocities_along_world_axes(shared_env: SharedEnv) -> None:
    pushed = shared_env("go1_velocity", nworld=1000, autoreset=False, **NOISELESS, command_seconds=NEVER)
    weak = {"push_velocity": (0.0, 0.0, 0.0), "push_spin": (0.0, 0.0, 0.0)}
    still = shared_env("go1_velocity", nworld=1000, autoreset=False, **NOISELESS, command_seconds=NEVER, **weak)
    state = pushed.get_state()
    parts = pushed.state_space.split(state)
    parts["push_timer"][:, 0] = torch.where(torch.arange(1000) < 900, 0.02, 0.5)
    still.set_state(state)
    pushed.set_state(state)
    action = torch.zeros(1000, 12)
    pushed.step(action)
    still.step(action)
    assert torch.equal(pushed.reward, still.reward), "the transition ends before the push"
    one, other = (env.state_space.split(env.get_state()) for env in (pushed, still))
    assert torch.equal(one["qpos"], other["qpos"])
    change = (one["qvel"] - other["qvel"]).numpy()
    assert not change[900:].any() and np.abs(change[:, 6:]).max() < 1e-6  # a push rounds velocities to float32
    axes = np.zeros((1000, 9))
    for row, quat in zip(axes, one["qpos"][:, 3:7].numpy(), strict=True):
        mujoco.mju_quat2Mat(row, quat)
    spin = np.einsum("nij,nj->ni", axes.reshape(-1, 3, 3), change[:, 3:6])
    sizes = np.array([0.5, 0.5, 0.4, 0.52, 0.52, 0.78])
    check_uniform(np.hstack([change[:, :3], spin])[:900] / (sizes * (1 + 1e-4)))
    timers = one["push_timer"][:, 0].numpy()
    check_uniform((timers[:900, None] - 2) / (1 + 1e-6))
    np.testing.assert_allclose(timers[900:], 0.48, atol=1e-6)


def test_robots_differ_in_friction_centre_of_mass_and_encoders() -> None:
    env = lw.make("go1_velocity", nworld=1000, seed=0)
    friction = env.field("geom_friction").numpy().copy()
    feet = [env.model.geom(name).id for name in FEET]
    assert (friction[:, feet] == friction[:, feet[:1]]).all()
    others = np.delete(np.arange(env.model.ngeom), feet)
    assert (friction[:, others] == np.float32(env.model.geom_friction[others])).all()
    drawn = friction[:, feet[0]].astype(np.float64)
    drawn[:, 1:] = np.log(drawn[:, 1:])
    bounds = np.array([[0.3, 1.5], np.log([1e-4, 2e-2]), np.log([1e-5, 5e-3])]).T
    offset = env.field("body_ipos").numpy()[:, 1] - env.model.body_ipos[1]
    bias = env.state_space.split(env.get_state())["encoder_bias"].numpy() / 0.015
    scaled = (2 * drawn - bounds.sum(axis=0)) / (bounds[1] - bounds[0])
    samples = np.hstack([scaled, offset / [0.025, 0.025, 0.03], bias])
    check_uniform(samples / (1 + 1e-4))
    env.rand_reset()
    assert np.array_equal(env.field("geom_friction").numpy(), friction)
    again = env.state_space.split(env.get_state())["encoder_bias"].numpy() / 0.015
    assert np.array_equal(again, bias)


def test_resets_put_the_robot_above_the_floor_in_its_default_pose(shared_env: SharedEnv) -> None:
    env = shared_env("go1_velocity", nworld=1000)
    qpos, qvel = (state_parts(env)[name].numpy() for name in ("qpos", "qvel"))
    np.testing.assert_allclose(qpos[:, 7:], np.tile(HOME, (1000, 1)), atol=1e-6)
    assert not qvel.any() and not qpos[:, 4:6].any()
    yaw = 2 * np.arctan2(qpos[:, 6], qpos[:, 3])
    yaw = (yaw + np.pi) % (2 * np.pi) - np.pi
    start = np.stack([qpos[:, 0] / 0.5, qpos[:, 1] / 0.5, (qpos[:, 2] - 0.308) / 0.02, yaw / 3.14], axis=1)
    check_uniform(start / (1 + 1e-4))
    env.reset()
    wanted = np.hstack([[0, 0, 0.278, 1, 0, 0, 0], HOME])
    np.testing.assert_allclose(env.field("qpos").numpy(), np.tile(wanted, (1000, 1)), atol=1e-6)
    torch.testing.assert_close(env.eval, env.obs[:, 45:47].norm(dim=1))  # the robots do not move yet
