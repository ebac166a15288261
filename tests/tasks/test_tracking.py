"""Compare the tracking tasks with mjlab's formulas, computed anew from MuJoCo's own quantities."""

import copy
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from conftest import SharedEnv
from motion_files import go1_clip, write_csv, write_npz

import lyceum_warp as lw
from lyceum_warp.algos.common.symmetry import Reflected, reflections
from lyceum_warp.motions import kinematics

NOISES = dict.fromkeys(
    ("position_noise", "rotation_noise", "linear_velocity_noise", "angular_velocity_noise", "joint_position_noise",
     "joint_velocity_noise"), 0.0,
)  # fmt: skip
BODY = mujoco.mjtObj.mjOBJ_XBODY


def quat(function: Any, *quats: np.ndarray, size: int = 4) -> np.ndarray:
    out = np.zeros(size)
    function(out, *quats)
    return out


def rotated(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    return quat(mujoco.mju_rotVecQuat, v, q, size=3)


def inverse(q: np.ndarray) -> np.ndarray:
    return quat(mujoco.mju_negQuat, q)


def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return quat(mujoco.mju_mulQuat, a, b)


def angle(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.linalg.norm(quat(mujoco.mju_subQuat, a, b, size=3)))


def axes(q: np.ndarray) -> np.ndarray:
    return quat(mujoco.mju_quat2Mat, q, size=9).reshape(3, 3).T[:2].ravel()


class Robot:
    """Poses and velocities of the tracked bodies in one state."""

    def __init__(self, env: lw.Env, qpos: np.ndarray, qvel: np.ndarray) -> None:
        model, data = env.task.model, mujoco.MjData(env.task.model)
        data.qpos, data.qvel = qpos, qvel
        mujoco.mj_forward(model, data)
        bodies, velocity = env.task.params["bodies"], np.zeros(6)
        self.x, self.q = data.xpos[bodies].copy(), data.xquat[bodies].copy()
        self.v, self.w = np.zeros_like(self.x), np.zeros_like(self.x)
        for i, body in enumerate(bodies):
            mujoco.mj_objectVelocity(model, data, BODY, body, velocity, 0)
            self.w[i], self.v[i] = velocity[:3], velocity[3:]
        self.qpos, self.qvel = data.qpos.copy(), data.qvel.copy()

    @staticmethod
    def reference(env: lw.Env, row: int) -> "Robot":
        params = env.task.params
        return Robot(env, params["clips"][row, 2:], params["reference_qvel"][row])

    @property
    def down(self) -> float:
        return float(rotated(inverse(self.q[0]), np.array([0.0, 0.0, -1.0]))[2])


def expected(env: lw.Env, robot: Robot, reference: Robot, action: np.ndarray, before: np.ndarray) -> dict[str, float]:
    """The reward terms without weights, the metrics and the ends, by mjlab's formulas."""
    params = env.task.params
    turn = product(robot.q[0], inverse(reference.q[0]))
    w, x, y, z = turn
    yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    turn = np.array([np.cos(yaw / 2.0), 0.0, 0.0, np.sin(yaw / 2.0)])
    place = np.array([*robot.x[0, :2], reference.x[0, 2]])
    relative = np.array([place + rotated(turn, point - reference.x[0]) for point in reference.x])
    off = np.linalg.norm(relative - robot.x, axis=1)
    angles = np.array([angle(product(turn, r), q) for r, q in zip(reference.q, robot.q, strict=True)])
    joints, dofs, n = params["joint_qpos"], params["joint_dof"], params["ends"]
    limits = env.task.model.jnt_range[params["joints"]]
    middle, half = limits.mean(1), 0.45 * (limits[:, 1] - limits[:, 0])
    heights = np.abs(relative[: n + 1, 2] - robot.x[: n + 1, 2])
    return {
        "anchor_position": np.exp(-np.sum((reference.x[0] - robot.x[0]) ** 2) / 0.3**2),
        "anchor_rotation": np.exp(-(angle(reference.q[0], robot.q[0]) ** 2) / 0.4**2),
        "body_position": np.exp(-np.mean(off**2) / 0.3**2),
        "body_rotation": np.exp(-np.mean(angles**2) / 0.4**2),
        "body_velocity": np.exp(-np.mean(np.sum((reference.v - robot.v) ** 2, 1)) / 1.0),
        "body_spin": np.exp(-np.mean(np.sum((reference.w - robot.w) ** 2, 1)) / 3.14**2),
        "action_rate_l2": np.sum((action - before) ** 2),
        "joint_limits": np.maximum(np.abs(robot.qpos[joints] - middle) - half, 0.0).sum(),
        "mpkpe": np.linalg.norm(reference.x - robot.x, axis=1).mean(),
        "r_mpkpe": off.mean(),
        "joint_position_error": np.sqrt(np.mean((robot.qpos - reference.qpos)[joints] ** 2)),
        "joint_velocity_error": np.sqrt(np.mean((robot.qvel - reference.qvel)[dofs] ** 2)),
        "end_position_error": off[1 : n + 1].mean(),
        "end_rotation_error": angles[1 : n + 1].mean(),
        "anchor_height": heights[0] > params["height_limit"],
        "anchor_tilt": abs(robot.down - reference.down) > 0.8,
        "end_height": heights[1:].max() > params["height_limit"],
    }


def observation(env: lw.Env, robot: Robot, target: Robot, action: np.ndarray, bias: np.ndarray) -> np.ndarray:
    """The parts of the critic's observation, with the policy's first."""
    params = env.task.params
    joints, dofs = params["joint_qpos"], params["joint_dof"]
    back, spin = inverse(robot.q[0]), robot.qvel[3:6]
    base = inverse(robot.qpos[3:7])
    return np.concatenate([
        target.qpos[joints], target.qvel[dofs], axes(product(back, target.q[0])), spin,
        robot.qpos[joints] - params["default_pose"] + bias, robot.qvel[dofs], action,
        rotated(back, target.x[0] - robot.x[0]),
        rotated(base, robot.qvel[:3]) + np.cross(spin, np.asarray(params["imu"])),
        *(rotated(back, x - robot.x[0]) for x in robot.x), *(axes(product(back, q)) for q in robot.q),
    ])  # fmt: skip


def test_observations_rewards_and_ends_are_mjlabs() -> None:
    env = lw.make("go1_tracking", nworld=6, autoreset=False, push_seconds=[1e6, 1e6], **NOISES)
    weights = env.task.definition.rewards
    rng = np.random.default_rng(0)
    last, ends = np.zeros((6, 12)), set[str]()
    bias = env.lasting["encoder_bias"].numpy()
    for step in range(40):
        action = rng.normal(size=(6, 12)).astype(np.float32) * (0.3 if step < 20 else 2.0)
        env.step(torch.from_numpy(action))
        parts = env.state_space.split(env.get_state())
        for world in range(6):
            robot = Robot(env, parts["qpos"][world].numpy(), parts["qvel"][world].numpy())
            row, clip = int(parts["frame"][world, 0]), int(parts["clip"][world, 0])
            first, count = env.task.params["ranges"][clip]
            terms = expected(env, robot, Robot.reference(env, row), action[world], last[world])
            for name, value in terms.items():
                scale = weights.get(name, 1.0) * (env.timestep if name in weights else 1.0)
                assert env.metrics[name][world].item() == pytest.approx(scale * value, abs=1e-5), (name, step)
                if isinstance(value, bool | np.bool_) and value:
                    ends.add(name)
            target = Robot.reference(env, min(row + 1, first + count - 1))
            seen = observation(env, robot, target, action[world], bias[world])
            np.testing.assert_allclose(env.obs[world].numpy(), seen[: env.obs.shape[1]], atol=1e-5)
            unbiased = observation(env, robot, target, action[world], np.zeros(12))
            np.testing.assert_allclose(env.obs_groups["critic"][world].numpy(), unbiased, atol=1e-5)
        last = action
    assert {"anchor_height", "end_height"} <= ends and env.terminated.any()


def test_self_collisions_cost_their_substeps(shared_env: SharedEnv) -> None:
    env = shared_env("go1_tracking", nworld=2, randomness=0.0, start_clip=0, start_frame=0)
    state = env.get_state()
    parts = env.state_space.split(state)
    parts["qpos"][1, 7:13] = torch.tensor([0.6, 0.9, -1.8, -0.6, 0.9, -1.8])  # the front legs cross
    parts["qpos"][:, 2] += 1.0
    env.set_state(state)
    env.step(torch.zeros(2, 12))
    cost = env.metrics["self_collision"] / (-10.0 * env.timestep)
    assert cost[0] == 0.0 and cost[1].item() == pytest.approx(4.0)


def test_episodes_begin_on_the_reference_and_end_with_the_clip(shared_env: SharedEnv) -> None:
    env = shared_env("go1_tracking", nworld=3, randomness=0.0, start_clip=[0, 2, 3], start_frame=198, height_limit=9.0)
    table, ranges = env.task.params["clips"], env.task.params["ranges"]
    parts = env.state_space.split(env.get_state())
    rows = ranges[[0, 2, 3], 0] + 198
    np.testing.assert_allclose(parts["qpos"], table[rows, 2:], atol=1e-6)
    np.testing.assert_allclose(parts["qvel"], env.task.params["reference_qvel"][rows], atol=1e-6)
    env.step(torch.zeros(3, 12))
    assert not env.done.any() and env.metrics["r_mpkpe"].max() < 0.05
    env.step(torch.zeros(3, 12))
    assert env.truncated.all() and not env.terminated.any() and env.metrics["clip_end"].all()


def test_clips_of_any_length_share_one_policy(tmp_path: Path) -> None:
    model = lw.make("go1_tracking").model
    write_npz(tmp_path / "a.npz", model, go1_clip(0)[:60], 50.0)
    write_csv(tmp_path / "b.csv", go1_clip(1))
    clips = lw.load_clips({tmp_path / "a.npz": 1.0, tmp_path / "b.csv": 3.0}, model)
    env = lw.make("go1_tracking", nworld=256, clips=clips)
    parts = env.state_space.split(env.get_state())
    ranges = env.task.params["ranges"]
    assert ranges[:, 1].tolist() == [60, len(clips.qpos[1])]
    drawn = parts["clip"][:, 0].numpy()
    weights = np.array([59.0, 3.0 * (len(clips.qpos[1]) - 1)])
    assert drawn.mean() == pytest.approx(weights[1] / weights.sum(), abs=0.05)
    first = ranges[drawn.astype(int), 0]
    frames = parts["frame"][:, 0].numpy() - first
    assert (frames >= 0).all() and (frames < ranges[drawn.astype(int), 1] - 1).all()
    with pytest.raises(ValueError, match=r"the clips have 50 frames per second.*load them with rate=100"):
        lw.make("go1_tracking", clips=clips, frame_skip=2)
    with pytest.raises(ValueError, match="the clips have 12 joints and a base, but the model has 36 coordinates"):
        lw.make("g1_tracking", clips=clips)
    with pytest.raises(ValueError, match="start_clip=9 must be less than 2, the number of clips"):
        lw.make("go1_tracking", clips=clips, start_clip=9)
    for column, value in ((1, -1.0), (5, 3.0)):
        table = np.array(env.task.params["clips"])
        table[:, column] = value
        with pytest.raises(ValueError, match="a positive weight, a position and a unit quaternion"):
            lw.make("go1_tracking", clips=table)


def test_failures_move_starts_to_their_bins() -> None:
    env = lw.make("go1_tracking", nworld=32, horizon=30, bin_seconds=0.5, height_limit=0.05)
    bins = env.task.params["bins"]
    shares = np.diff(env.task.params["bin_starts"], prepend=0.0)
    used = bins[:, 2] > 0
    assert used.sum() == 32 and len(bins) == 256 and shares.sum() == pytest.approx(1.0)
    counts, total = np.zeros(256), 0.0
    for _ in range(2):
        failures, ended = np.zeros(256), 0
        for _ in range(20):
            frames = env.state_space.split(env.get_state())["frame"][:, 0].numpy() + 1
            env.step(0.3 * torch.ones(32, 12))
            ended += int(env.done.sum())
            for row in frames[env.terminated.numpy()]:
                failures[np.flatnonzero(used & (bins[:, 1] <= row))[-1]] += 1.0
        env.update_shared()
        counts, total = 0.976 * counts + failures, 0.976 * total + ended
        np.testing.assert_allclose(env.shared["failures"], counts, atol=1e-4)
        p = counts / total + 0.01 * shares
        np.testing.assert_allclose(env.shared["starts"], np.cumsum(p / p.sum()), atol=1e-4)
    assert counts.sum() > 10
    worst = int(counts.argmax())
    env.shared["starts"].copy_((torch.arange(256) >= worst).float())
    env.rand_reset(seed=3)
    frames = env.state_space.split(env.get_state())["frame"][:, 0]
    assert (frames >= bins[worst, 1]).all() and (frames < bins[worst, 1] + bins[worst, 2]).all()


def test_failures_count_for_earlier_bins_of_the_same_clip(shared_env: SharedEnv) -> None:
    env = shared_env("go1_tracking", nworld=1, earlier_bins=3, uniform_weight=0.0)
    sums = torch.zeros(env.get_shared().numel(), dtype=torch.float64)
    n = len(env.task.params["bins"])
    sums[1 + 2 * n], sums[1 + 2 * n + 1 + 5] = 2.0, 1.0  # two episodes, a failure in the second bin of the second clip
    env.set_shared(sums)
    env.update_shared()
    p = env.shared["starts"].diff(prepend=torch.zeros(1))
    np.testing.assert_allclose(p[:8], [0, 0, 0, 0, 0.8 / 1.8, 1.0 / 1.8, 0, 0], atol=1e-5)


def test_blind_robots_do_not_observe_position_and_velocity() -> None:
    env = lw.make("g1_blind_tracking", nworld=2)
    parts = env.obs_spaces["policy"].parts
    assert "anchor_position" not in parts and "linear_velocity" not in parts and env.obs.shape[1] == 154
    assert env.obs_groups["critic"].shape[1] == 286
    env.step(torch.zeros(2, 29))
    assert env.metrics["r_mpkpe"].max() < 0.2


MEMORY = dict(qpos="qpos", qvel="qvel", last_action="last_action", encoder_bias="joint_position")


def test_body_that_is_tracked_on_one_side_only_has_no_mirror_image(shared_env: SharedEnv) -> None:
    env = shared_env("go1_tracking", nworld=1)
    params = SimpleNamespace(**env.task.params)
    params.bodies = np.asarray(params.bodies)[:-1]
    with pytest.raises(
        ValueError, match="'RR_hip' has no mirror image among the others: place or name one on each side"
    ):
        env.task.definition.mirror(env.model, params)


def test_mirror_image_does_not_depend_on_where_the_base_begins(shared_env: SharedEnv) -> None:
    env = shared_env("go1_tracking", nworld=1)
    model, params = copy.copy(env.model), SimpleNamespace(**env.task.params)
    model.qpos0[1] = 0.3
    moved, mirror = (env.task.definition.mirror(each, params).parts["body_position"] for each in (model, env.model))
    np.testing.assert_array_equal(moved, mirror)


@pytest.mark.parametrize("task", ["g1_tracking", "go1_tracking"])
def test_observations_of_mirrored_robots_on_mirrored_clips_are_mirrored(task: str, shared_env: SharedEnv) -> None:
    own: dict[str, Any] = {"randomness": 0.0, "imu": (0.01, 0.0, 0.02)}  # the velocimeter is in the plane of symmetry
    env = shared_env(task, nworld=8, **own)
    mirror = env.task.definition.mirror(env.model, SimpleNamespace(**env.task.params))
    clips = np.array(env.task.params["clips"])
    order, signs = mirror.parts["qpos"]
    clips[:, 2:] = clips[:, 2:][:, order] * signs
    images = lw.make(task, nworld=8, clips=clips, **own)
    for _ in range(5):
        env.step(0.3 * torch.randn(env.action.shape, generator=torch.Generator().manual_seed(0)))
    obs, state = {name: rows.clone() for name, rows in env.obs_groups.items()}, env.get_state()
    for name, part in env.state_space.split(state).items():
        if name in MEMORY:
            order, signs = mirror.parts[MEMORY[name]]
            part.copy_(part[:, order] * torch.tensor(signs))
    for group, rows in obs.items():
        image = Reflected(reflections(env, group=group)["obs"])(rows)
        torch.testing.assert_close(images.get_obs(state, group=group), image, atol=2e-5, rtol=1e-4)
        assert (image - rows).abs().mean() > 0.05


def test_evaluation_plays_each_clip_once(shared_env: SharedEnv) -> None:
    env = shared_env("go1_tracking", nworld=1)
    results = lw.evaluate_clips(env, lambda obs: torch.zeros(len(obs), 12), physics="exact")
    assert results.failed.shape == (4,) and results.worst_states.shape == (4, env.state_space.size)
    assert ((results.tracked < results.seconds) == results.failed).all() and 0.0 < results.scores.min() < 0.7
    again = lw.evaluate_clips(env, lambda obs: torch.zeros(len(obs), 12), physics="exact")
    assert again.to_dict() == results.to_dict()
    verdict = lw.gate(env, lambda obs: torch.zeros(len(obs), 12))
    assert verdict.numbers["failures"] == results.failures and not verdict.passed
    worst = int(results.worst[0] / env.timestep + 0.5)
    row = int(env.state_space.split(results.worst_states)["frame"][0, 0])
    assert row == worst and results.errors["r_mpkpe"][0] > 0.02
    with pytest.raises(ValueError, match="tracks no clips"):
        lw.evaluate_clips(shared_env("point_mass"), lambda obs: obs)
    with pytest.raises(ValueError, match="policy must return"):
        lw.evaluate_clips(env, lambda obs: obs)


def test_saved_episodes_hold_no_table_of_the_package(tmp_path: Path) -> None:
    env = lw.make("go1_tracking", autoreset=False, start_clip=1)
    episode = lw.control(env, lambda state, obs: torch.zeros(12), steps=10)
    assert "reference_position" not in episode.params and episode.params["start_clip"] == 1
    assert episode.save(tmp_path / "episode.npz").stat().st_size < 100_000
    clip = lw.load_clips(tmp_path, env.model).qpos[0]
    np.testing.assert_allclose(clip, episode.part("qpos"), atol=1e-6)


def test_velocities_of_the_reference_are_differences(shared_env: SharedEnv) -> None:
    env = shared_env("go1_tracking", nworld=1)
    params = env.task.params
    qvel = kinematics.reference_of(env.model, go1_clip(2), env.timestep).qvel
    first, count = params["ranges"][2]
    np.testing.assert_allclose(params["reference_qvel"][first : first + count], qvel, atol=1e-4)
