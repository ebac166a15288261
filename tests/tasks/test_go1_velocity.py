"""Test go1_velocity.

oracles/test_mjlab.py compares its observations, rewards and terminations with those of mjlab.
"""

import itertools

import mujoco
import numpy as np
import pytest
import torch
from checks import check_uniform
from conftest import SharedEnv
from go1_states import DT, GO1, HOME, LEGS, NEVER, NOISELESS, STILL, SUBSTEP, State, random_steps

import lyceum_warp as lw

NWORLD = 64


def roll_out(env: lw.Env, steps: int, size: float = 1.0) -> torch.Tensor:
    actions = random_steps(env, steps, size)
    for action in actions:
        env.step(action)
    return actions[-1]


def test_forces_are_zero_until_the_first_substep(shared_env: SharedEnv) -> None:
    env = shared_env("go1_velocity", nworld=NWORLD)
    roll_out(env, 20)
    env.rand_reset()
    assert not env.field("sensordata").any() and not env.obs_groups["critic"][:, -12:].any()
    for _ in range(10):
        roll_out(env, 1, 0.0)
    assert (env.field("sensordata")[:, 2::3].abs() > 1.0).any(dim=1).float().mean() > 0.9  # the robots stand


def test_policy_observations_have_uniform_noise_and_critic_observations_have_none(shared_env: SharedEnv) -> None:
    env = shared_env("go1_velocity", nworld=1000)
    roll_out(env, 2)
    clean = shared_env("go1_velocity", nworld=1000, **NOISELESS)
    clean.set_state(env.get_state())
    noise = (env.obs - clean.obs).numpy()
    assert torch.equal(env.obs_groups["critic"], clean.obs_groups["critic"])
    assert not noise[:, 33:].any()
    sizes = np.repeat([0.5, 0.2, 0.05, 0.01, 1.5], [3, 3, 3, 12, 12])
    check_uniform(noise[:, :33] / (sizes * (1 + 1e-3)))


def test_foot_timers_count_substeps_in_contact_and_in_the_air(shared_env: SharedEnv) -> None:
    """Compare timers with MuJoCo's contacts after every substep."""
    env = shared_env("go1_velocity", nworld=4, autoreset=False, **STILL)
    model = mujoco.MjModel.from_xml_path(GO1)
    feet = [model.geom(f"{leg}_foot").id for leg in LEGS]
    states = [State(env)]
    actions = random_steps(env, 40)
    for action in actions:
        env.step(action)
        states.append(State(env))
    landings = 0
    for i in range(env.nworld):
        for s0, s1 in itertools.pairwise(states):
            model.geom_friction[:] = s0.parts["geom_friction"][i].reshape(-1, 3)
            model.body_ipos[:] = s0.parts["body_ipos"][i].reshape(-1, 3)
            data = mujoco.MjData(model)
            mujoco.mj_setConst(model, data)
            data.qpos, data.qvel, data.ctrl = s0.qpos[i], s0.qvel[i], s1.parts["ctrl"][i]
            data.qacc_warmstart = s0.parts["qacc_warmstart"][i]
            contact, air = s0.contact_time[i].copy(), s0.air_time[i].copy()
            for _ in range(4):
                mujoco.mj_step(model, data)
                mujoco.mj_forward(model, data)
                touching = np.isin(feet, data.contact.geom[(data.contact.geom == 0).any(axis=1)])
                landings += int((touching & (contact == 0)).sum())
                contact, air = np.where(touching, contact + SUBSTEP, 0), np.where(touching, 0, air + SUBSTEP)
            np.testing.assert_allclose(s1.contact_time[i], contact, atol=1e-6)
            np.testing.assert_allclose(s1.air_time[i], air, atol=1e-6)
    assert landings > 20


def test_peak_height_of_a_foot_becomes_zero_only_at_a_landing(shared_env: SharedEnv) -> None:
    env = shared_env("go1_velocity", nworld=16, autoreset=False, **STILL)
    landings, before = 0, State(env)
    for action in random_steps(env, 30):
        env.step(action)
        s = State(env)
        landed = (s.contact_time > 0) & (s.contact_time < DT + 1e-6)
        grown = np.where(s.touching, before.peak, np.maximum(before.peak, s.height))
        np.testing.assert_allclose(s.peak, np.where(landed, 0.0, grown), atol=1e-6)
        landings, before = landings + landed.sum(), s
    assert landings > 50
    env.rand_reset()
    s = State(env)
    assert np.array_equal(s.peak, before.peak) and s.peak.max() > 0.02
    assert not s.contact_time.any() and not s.air_time.any() and not s.last_action.any()


@pytest.mark.usefixtures("freed")
def test_commands_have_the_distribution_of_mjlab() -> None:
    env = lw.make("go1_velocity", nworld=4000, seed=0)
    s = State(env)
    vx, vy, yaw = s.drawn.T
    forward = (vy == 0) & (yaw == 0)
    for share, wanted in ((forward, 0.2), (s.heading_controlled, 0.3), (s.standing, 0.1)):
        assert abs(share.mean() - wanted) < 4 * np.sqrt(wanted * (1 - wanted) / 4000)
    timers = (s.command_timer - 5.5) / 2.5, s.push_timer - 2
    drawn = np.stack([vx, vy, 2 * yaw, s.heading_target / np.pi, *timers], axis=1)
    check_uniform(drawn[~forward] / (1 + 1e-6))
    assert vx[forward].min() == np.float32(0.3) and vx[forward].max() <= 1
    assert abs((vx[forward] == np.float32(0.3)).mean() - 0.3) < 0.07
    flags = np.stack([forward, s.heading_controlled, s.standing], axis=1)
    assert np.abs(np.corrcoef(flags.T) - np.eye(3)).max() < 5.5 / np.sqrt(4000)


def command_of(env: lw.Env) -> torch.Tensor:
    """Return each world's random velocity, heading and command timer.

    The shape is (nworld, 5).
    """
    parts = env.state_space.split(env.get_state())
    return torch.cat([parts[name] for name in ("drawn_velocity", "heading_target", "command_timer")], dim=1)


def test_commands_change_when_their_timers_expire(shared_env: SharedEnv) -> None:
    nworld = 24
    env = shared_env("go1_velocity", nworld=nworld, autoreset=False, **NOISELESS, push_seconds=NEVER)
    action = torch.zeros(nworld, 12)
    changes, before = 0, command_of(env)
    for _ in range(300):
        env.step(action)
        command = command_of(env)
        due = before[:, 4] - DT <= 1e-9
        changed = (command[:, :4] != before[:, :4]).any(dim=1)
        assert torch.equal(changed, due)
        torch.testing.assert_close(command[~due, 4], before[~due, 4] - DT, atol=1e-6, rtol=0)
        assert (command[due, 4] >= 3).all() and (command[due, 4] <= 8).all()
        changes, before = changes + int(due.sum()), command
    assert 0.3 * nworld < changes < 0.9 * nworld  # the steps take 6 s, and commands change every 3 to 8 s


def test_curriculum_widens_the_command_ranges_at_each_stage() -> None:
    env = lw.make("go1_velocity", nworld=1000, **NOISELESS)
    for steps, low, high, yaw in ((119_998, -1, 1, 0.5), (119_999, -1.5, 2, 0.7), (239_999, -2, 3, 0.7)):
        state = env.get_state()
        parts = env.state_space.split(state)
        parts["env_steps"][:] = steps
        parts["command_timer"][:] = 0.0
        env.set_state(state)
        env.step(torch.zeros(1000, 12))
        drawn = State(env).drawn
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
    feet = [env.model.geom(f"{leg}_foot").id for leg in LEGS]
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


@pytest.mark.quick("mujoco")
@pytest.mark.parametrize("engine", ["mujoco", "warp"])
def test_resets_put_the_robot_above_the_floor_in_its_default_pose(shared_env: SharedEnv, engine: str) -> None:
    n = 1000 if engine == "mujoco" else 4
    env = shared_env("go1_velocity", engine=engine, nworld=n)
    qpos, qvel = (env.state_space.split(env.get_state())[name].numpy() for name in ("qpos", "qvel"))
    np.testing.assert_allclose(qpos[:, 7:], np.tile(HOME, (n, 1)), atol=1e-6)
    assert not qvel.any() and not qpos[:, 4:6].any()
    yaw = 2 * np.arctan2(qpos[:, 6], qpos[:, 3])
    yaw = (yaw + np.pi) % (2 * np.pi) - np.pi
    start = np.stack([qpos[:, 0] / 0.5, qpos[:, 1] / 0.5, (qpos[:, 2] - 0.308) / 0.02, yaw / 3.14], axis=1)
    if engine == "mujoco":
        check_uniform(start / (1 + 1e-4))
    assert np.abs(start).max() < 1 + 1e-4
    env.reset()
    wanted = np.hstack([[0, 0, 0.278, 1, 0, 0, 0], HOME])
    np.testing.assert_allclose(env.field("qpos").numpy(), np.tile(wanted, (n, 1)), atol=1e-6)
    torch.testing.assert_close(env.eval, env.obs[:, 45:47].norm(dim=1))  # the robots do not move yet
