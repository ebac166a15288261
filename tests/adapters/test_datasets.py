import json
from pathlib import Path

import pytest
import torch
from conftest import SharedEnv

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


def test_lerobot_dataset_has_a_row_for_each_step(episodes: list[Trajectory], tmp_path: Path) -> None:
    pandas = pytest.importorskip("pandas")
    pytest.importorskip("pyarrow")
    folder = write_lerobot(episodes, tmp_path / "data", instruction="hop")
    rows = pandas.read_parquet(folder / "data/chunk-000/file-000.parquet")
    steps = [episode.steps for episode in episodes]
    assert len(rows) == sum(steps) and rows["next.done"].sum() == 2
    assert rows["observation.state"][steps[0]].tolist() == episodes[1].obs[0].tolist()
    assert json.loads((folder / "meta/info.json").read_text())["fps"] == 125
