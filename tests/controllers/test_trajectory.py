import dataclasses
import json
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from toy_controllers import towards

import lyceum_warp as lw
from lyceum_warp.controllers import Trajectory, control


@pytest.fixture(scope="module")
def env() -> lw.Env:
    return lw.make("point_mass", engine="mujoco", autoreset=False, horizon=40)


@pytest.fixture(scope="module")
def episode(env: lw.Env) -> Trajectory:
    return control(env, towards, seed=3)


def test_loaded_trajectory_equals_the_saved_trajectory(episode: Trajectory, tmp_path: Path) -> None:
    path = episode.save(tmp_path / "new" / "episode.npz")
    assert [file.name for file in path.parent.iterdir()] == ["episode.npz"]
    loaded = Trajectory.load(path)
    for field in dataclasses.fields(Trajectory):
        one, other = getattr(episode, field.name), getattr(loaded, field.name)
        if isinstance(one, torch.Tensor):
            assert one.dtype == other.dtype and torch.allclose(one, other, rtol=0, atol=0, equal_nan=True), field.name
        else:
            assert one == other, field.name
    assert loaded.params["success_distance"] == pytest.approx(0.05) and loaded.versions["torch"]


def test_trajectory_file_contains_column_names_and_planner_settings(env: lw.Env, tmp_path: Path) -> None:
    plan = lw.MPPI("point_mass", horizon=4, samples=3, temperature=0.3, nthread=1)
    path = control(env, plan, steps=3, seed=7).save(tmp_path / "episode.npz")
    with np.load(path, allow_pickle=False) as file:
        info = json.loads(str(file["info"]))
        assert info["seed"] == 7 and info["action_names"] == ["x", "y"] and info["task"] == "point_mass"
        start, stop = info["state_parts"]["step"]
        assert file["states"][:, start:stop].ravel().tolist() == [0, 1, 2, 3]
        assert max(stop for _, stop in info["obs_parts"].values()) == file["obs"].shape[1]
        assert max(stop for _, stop in info["state_parts"].values()) == file["states"].shape[1]
    controller = info["controller"]
    assert controller["name"] == "MPPI" and controller["engine"] == "mujoco" and controller["device"] == "cpu"
    assert controller.items() >= plan.settings.items() and controller["temperature"] == 0.3


def test_damaged_trajectory_file_raises_an_error(episode: Trajectory, tmp_path: Path) -> None:
    path = episode.save(tmp_path / "whole.npz")
    with zipfile.ZipFile(path) as archive:
        states = archive.getinfo("states.npy")
    whole, broken = path.read_bytes(), tmp_path / "broken.npz"
    half = len(whole) // 2
    data = states.header_offset + 100 + states.compress_size // 2
    for content in (
        b"", b"no zip", whole[:half], whole[:-1], whole[:data] + b"????????" + whole[data + 8 :],
        whole[:-6] + b"????" + whole[-2:],  # the archive's directory lies beyond the end of the file
    ):  # fmt: skip
        broken.write_bytes(content)
        with pytest.raises(ValueError, match=r"broken\.npz is broken, or is not a trajectory"):
            Trajectory.load(broken)


def test_arrays_of_inconsistent_shapes_raise_an_error(episode: Trajectory, tmp_path: Path) -> None:
    broken = tmp_path / "broken.npz"
    with np.load(episode.save(tmp_path / "whole.npz")) as file:
        arrays = dict(file)
    for change in (
        {"plan_failed": arrays["plan_failed"][1:]},
        {"rewards": arrays["rewards"][:-1]}, {"states": arrays["states"][:, 0]}, {"plan_of": arrays["plan_of"] + 1},
        {"info": np.array("{}")}, {"success": arrays["success"].astype(int)},
    ):  # fmt: skip
        np.savez(broken, **(arrays | change))
        with pytest.raises(ValueError, match=r"broken\.npz is broken, or is not a trajectory"):
            Trajectory.load(broken)
