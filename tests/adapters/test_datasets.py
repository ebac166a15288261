import io
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import SharedEnv

import lyceum_warp as lw
from lyceum_warp.adapters import write_lerobot, write_minari
from lyceum_warp.controllers import Trajectory, policy_episodes


@pytest.fixture
def episodes(shared_env: SharedEnv) -> list[Trajectory]:
    env = shared_env("hopper", nworld=2, autoreset=False, horizon=30)
    return list(policy_episodes(env, lambda obs: torch.ones(2, 3), 2, seed=0))


def test_minari_loads_written_episodes(
    episodes: list[Trajectory], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    minari = pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    write_minari(episodes, "hopper/ones-v0", description="all actions are 1")
    for episode, loaded in zip(episodes, minari.load_dataset("hopper/ones-v0").iterate_episodes(), strict=True):
        assert loaded.observations.tolist() == episode.obs.tolist()
        assert loaded.terminations[-1] == episode.terminated != loaded.truncations[-1]


def test_data_sets_hold_pictures(shared_env: SharedEnv, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    minari = pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    cameras = [lw.Camera("side", 16, 12), lw.Camera("side", 16, 12, "depth", "depth")]
    env = shared_env("cartpole", nworld=2, autoreset=False, horizon=10, cameras=cameras)
    episodes = list(policy_episodes(env, lambda obs: torch.ones(2, 1), 2, seed=0))
    write_minari(episodes, "cartpole/pixels-v0")
    for episode, loaded in zip(episodes, minari.load_dataset("cartpole/pixels-v0").iterate_episodes(), strict=True):
        assert loaded.observations["policy"].tolist() == episode.obs.tolist()
        for group, seen in episode.pictures.items():
            assert (loaded.observations[group] == seen.numpy()).all() and loaded.observations[group].std() > 0
    with pytest.raises(ValueError, match="LeRobot's images are colours, unlike the pictures 'depth'"):
        write_lerobot(episodes, tmp_path / "data")


def test_lerobot_images_are_the_colours_before_each_step(shared_env: SharedEnv, tmp_path: Path) -> None:
    pandas, image = pytest.importorskip("pandas"), pytest.importorskip("PIL.Image")
    pytest.importorskip("pyarrow")
    env = shared_env("cartpole", nworld=2, autoreset=False, horizon=10, cameras=[lw.Camera("side", 16, 12)])
    episodes = list(policy_episodes(env, lambda obs: torch.ones(2, 1), 2, seed=0))
    folder = write_lerobot(episodes, tmp_path / "data")
    rows = pandas.read_parquet(folder / "data/chunk-000/file-000.parquet")
    assert isinstance(rows["action"][0], np.float32)  # LeRobot reads actions of one joint as numbers
    decoded = np.asarray(image.open(io.BytesIO(rows["observation.images.camera"][13]["bytes"])))
    assert len(rows) == 20 and (decoded == episodes[1].pictures["camera"][3].numpy()).all()
    assert json.loads((folder / "meta/info.json").read_text())["features"]["observation.images.camera"] == {
        "dtype": "image", "shape": [12, 16, 3], "names": ["height", "width", "channels"],
    }  # fmt: skip
    stats = json.loads((folder / "meta/stats.json").read_text())["observation.images.camera"]
    assert np.shape(stats["mean"]) == (3, 1, 1) and 0 < stats["mean"][0][0][0] < stats["max"][0][0][0] <= 1


def test_lerobot_dataset_has_a_row_for_each_step(episodes: list[Trajectory], tmp_path: Path) -> None:
    pandas = pytest.importorskip("pandas")
    pytest.importorskip("pyarrow")
    folder = write_lerobot(episodes, tmp_path / "data", instruction="hop")
    rows = pandas.read_parquet(folder / "data/chunk-000/file-000.parquet")
    steps = [episode.steps for episode in episodes]
    assert len(rows) == sum(steps) and rows["next.done"].sum() == 2
    assert rows["observation.state"][steps[0]].tolist() == episodes[1].obs[0].tolist()
    assert json.loads((folder / "meta/info.json").read_text())["fps"] == 125
