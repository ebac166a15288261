import logging
import pickle
from pathlib import Path

import mujoco
import numpy as np
import pytest
from motion_files import go1, go1_clip, write_csv, write_npz, write_pickle

import lyceum_warp as lw
from lyceum_warp.motions import kinematics, rotations


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return go1()


def test_all_formats_give_the_same_clip(model: mujoco.MjModel, tmp_path: Path) -> None:
    qpos = go1_clip()
    write_npz(tmp_path / "a.npz", model, qpos, 50.0)
    write_pickle(tmp_path / "b.pkl", qpos, 50.0)
    write_pickle(tmp_path / "c.pkl", qpos.astype(np.float32), 50.0, protocol=5)
    write_pickle(tmp_path / "d.pkl", qpos, 50.0, protocol=2)
    clips = lw.load_clips(tmp_path, model)
    assert clips.names == ("a", "b", "c", "d") and clips.rate == 50.0 and clips.seconds == pytest.approx(16.0)
    for loaded in clips.qpos:
        np.testing.assert_allclose(loaded, qpos, atol=1e-6)
    slow = lw.load_clips(write_csv(tmp_path / "e.csv", qpos), model)  # 30 frames per second
    assert len(slow.qpos[0]) == int((len(qpos) - 1) / 30.0 * 50.0 + 1e-6) + 1
    np.testing.assert_allclose(slow.qpos[0][::5], qpos[::3], atol=1e-6)


def test_saved_episode_becomes_a_clip(tmp_path: Path) -> None:
    env = lw.make("go1_velocity", autoreset=False, horizon=20)
    episode = lw.control(env, lambda state, obs: 0.1 * obs[:12], seed=0)
    clips = lw.load_clips(episode.save(tmp_path / "episode.npz"), env.model, rate=1.0 / env.timestep)
    np.testing.assert_allclose(clips.qpos[0], episode.part("qpos").numpy(), atol=1e-6)
    episode.part("qpos")[:, 3:7] *= 1.1  # MuJoCo reads rotations of any length, such as those of Gymnasium's ant
    again = lw.load_clips(episode.save(tmp_path / "longer.npz"), env.model, rate=1.0 / env.timestep)
    np.testing.assert_allclose(again.qpos[0], clips.qpos[0], atol=1e-6)


def test_names_of_joints_put_them_into_order(model: mujoco.MjModel, tmp_path: Path) -> None:
    qpos, names = go1_clip(), [model.joint(i).name for i in range(1, model.njnt)]
    order = np.random.default_rng(0).permutation(12)
    other = np.hstack([qpos[:, :7], qpos[:, 7:][:, order]])
    content = dict(joint_pos=other[:, 7:], joint_names=np.array(names)[order])
    clips = lw.load_clips(write_npz(tmp_path / "mixed.npz", model, qpos, 50.0, **content), model)
    np.testing.assert_allclose(clips.qpos[0], qpos, atol=1e-6)
    holosoma = content | dict(joint_pos=other)  # with the base's pose
    clips = lw.load_clips(write_npz(tmp_path / "whole.npz", model, qpos, 50.0, **holosoma), model)
    np.testing.assert_allclose(clips.qpos[0], qpos, atol=1e-6)


def test_another_order_of_bodies_or_another_robot_is_refused(model: mujoco.MjModel, tmp_path: Path) -> None:
    qpos = go1_clip()
    positions = kinematics.reference_of(model, qpos, 0.02).positions
    breadth_first = [1, 2, 5, 8, 11, 3, 6, 9, 12, 4, 7, 10, 13]
    file = write_npz(tmp_path / "isaac.npz", model, qpos, 50.0, body_pos_w=positions[:, breadth_first])
    with pytest.raises(ValueError, match=r"isaac.npz does not fit.* is where the model has .*another order"):
        lw.load_clips(file, model)
    file = write_npz(tmp_path / "large.npz", model, qpos, 50.0, body_pos_w=1.1 * positions[:, 1:])
    with pytest.raises(ValueError, match=r"large.npz.*calf is off by 0\.\d+ m"):
        lw.load_clips(file, model)
    file = write_npz(tmp_path / "hand.npz", model, qpos, 50.0, body_pos_w=positions[:, 1:6])
    with pytest.raises(ValueError, match="has 5 bodies, but the model has 13"):
        lw.load_clips(file, model)
    with pytest.raises(ValueError, match=r"legs.csv does not fit the model: it has 3 joints, but the model has 12"):
        lw.load_clips(write_csv(tmp_path / "legs.csv", qpos[:, :10]), model)


def test_resampling_moves_at_constant_speed(model: mujoco.MjModel, tmp_path: Path) -> None:
    axis, qpos = np.array([0.6, 0.0, 0.8]), np.zeros((31, 19))
    times = np.arange(31) / 30.0
    qpos[:, 2] = 0.5 + 0.3 * times
    qpos[:, 3:7] = rotations.from_rotvec(2.0 * times[:, None] * axis)
    qpos[20:, 3:7] *= -1.0  # the same rotations
    clip = lw.load_clips(write_csv(tmp_path / "turn.csv", qpos), model, rate=100.0).qpos[0]
    times = np.arange(101) / 100.0
    np.testing.assert_allclose(clip[:, 2], 0.5 + 0.3 * times, atol=1e-9)
    velocity = kinematics.reference_of(model, clip, 0.01).qvel
    np.testing.assert_allclose(velocity[:, 2], 0.3, atol=1e-9)
    np.testing.assert_allclose(velocity[:, 3:6], 2.0 * axis + np.zeros((101, 1)), atol=1e-9)


def test_velocities_of_bodies_are_those_of_mujoco(model: mujoco.MjModel) -> None:
    qpos = go1_clip(1)
    qvel, _, _, velocities, spins = kinematics.reference_of(model, qpos, 0.02)
    data, out = mujoco.MjData(model), np.zeros(6)
    for frame, body in ((3, 1), (50, 4), (120, 13)):
        data.qpos, data.qvel = qpos[frame], qvel[frame]
        mujoco.mj_forward(model, data)
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, body, out, 0)
        np.testing.assert_allclose(np.r_[spins[frame, body], velocities[frame, body]], out, atol=1e-9)


def test_clips_are_selected_cut_looped_and_joined(model: mujoco.MjModel, tmp_path: Path) -> None:
    for clip, name in enumerate(("walk", "turn")):
        write_npz(tmp_path / f"{name}.npz", model, go1_clip(clip), 50.0)
    clips = lw.load_clips({tmp_path / "walk.npz": 1.0, tmp_path / "turn.npz": 3.0}, model)
    table = np.asarray(clips)
    assert table.shape == (402, 2 + 19) and kinematics.ranges(table).tolist() == [[0, 201], [201, 201]]
    assert table[:, 1].tolist() == 201 * [1.0] + 201 * [3.0] and table[1, 0] == np.float32(0.02)
    part = clips["turn"].cut(1.0, 3.0)
    assert np.array_equal(part.qpos[0], clips.qpos[1][50:151]) and part.weights == (3.0,)
    joined = (part + clips["walk"].cut(0.0, 2.0)).join(blend=0.2)
    looped = part.loop(3)
    assert (len(joined.qpos[0]), len(looped.qpos[0])) == (101 + 9 + 101, 3 * 101 + 2 * 9)
    fastest = np.abs(np.diff(np.concatenate(clips.qpos)[:, :2], axis=0)[:200]).max()
    for qpos in (*joined.qpos, *looped.qpos):
        steps = np.linalg.norm(np.diff(qpos[:, :2], axis=0), axis=1)
        assert steps.max() < 2.0 * fastest and steps.min() > 0.0
        turns = np.linalg.norm(rotations.angular_velocity(qpos[:, 3:7], 0.02), axis=1)
        assert turns.max() < 8.0
    # each repetition turns on by the same angle
    yaw = np.unwrap(rotations.yaw(looped.qpos[0][:, 3:7]))
    np.testing.assert_allclose(yaw[110] - yaw[0], yaw[220] - yaw[110], atol=1e-6)
    with pytest.raises(ValueError, match="walk has no part from 3 to 9 s: it lasts 4 s"):
        clips.cut(3.0, 9.0)
    with pytest.raises(KeyError, match="there is no clip 'wolk': did you mean"):
        clips["wolk"]


def test_impossible_motions_are_reported(
    model: mujoco.MjModel, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    qpos = go1_clip()
    qpos[:, 2] -= 0.1
    qpos[100:, 9] = -3.2
    qpos[:, 0] = 3.0 * np.arange(len(qpos)) / 50.0
    with caplog.at_level(logging.WARNING):
        lw.load_clips(write_npz(tmp_path / "bad.npz", model, qpos, 50.0), model)
    for text in ("calf sinks 11 cm", "contacts slip at 2.99 m/s", "FR_calf is 0.38 rad beyond its limit"):
        assert text in caplog.text


def test_clips_that_do_not_fit_into_memory_are_refused(model: mujoco.MjModel, tmp_path: Path) -> None:
    file = write_pickle(tmp_path / "long.pkl", go1_clip(), 50.0)
    with pytest.raises(ValueError, match=r"long.pkl take .* GB in the tables of a task, and cpu has"):
        lw.load_clips(file, model, rate=1e10)


@pytest.mark.parametrize("protocol", [0, 2, 4])
def test_code_in_a_pickle_is_refused(model: mujoco.MjModel, tmp_path: Path, protocol: int) -> None:
    class Code:
        def __reduce__(self) -> tuple[object, ...]:
            return (eval, ("1 / 0",))

    file = tmp_path / "code.pkl"
    file.write_bytes(pickle.dumps({"fps": Code()}, protocol=protocol))
    with pytest.raises(ValueError, match=r"code.pkl is broken.*it would run .*eval"):
        lw.load_clips(file, model)


def test_missing_files_and_models_without_a_base_are_refused(model: mujoco.MjModel, tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="no motion in the folder"):
        lw.load_clips(tmp_path, model)
    with pytest.raises(FileNotFoundError, match="missing.npz"):
        lw.load_clips(tmp_path / "missing.npz", model)
    with pytest.raises(ValueError, match="notes.txt is not a motion: its name must end in .npz, .csv, .pkl"):
        lw.load_clips(tmp_path / "notes.txt", model)
    with pytest.raises(ValueError, match="whose first joint is free"):
        lw.load_clips(tmp_path, lw.make("hopper").model)
