from pathlib import Path

import pytest
import torch

import lyceum_warp as lw
from lyceum_warp import cli


def test_new_tracking_task_stands_until_it_gets_clips(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert cli.main(["new", "ant_tracking", "--model", "gymnasium:ant.xml", "--template", "tracking"]) == 0
    text = Path("ant_tracking.py").read_text()
    assert len(text.splitlines()) < 60 and max(map(len, text.splitlines())) <= 120
    env = lw.make("ant_tracking.py", nworld=2, autoreset=False)
    params = env.task.params
    names = [env.model.body(body).name for body in params["bodies"]]
    assert names[0] == "torso" and params["ends"] == 4 and len(params["joints"]) == 8
    assert params["ranges"].tolist() == [[0, round(1.0 / env.timestep) + 1]]
    episode = lw.control(lw.make("ant_tracking.py", autoreset=False), lambda state, obs: torch.zeros(8), steps=20)
    clips = lw.load_clips(episode.save("fall.npz"), env.model, rate=1.0 / env.timestep)
    tracking = env.replicate(clips=clips, start_frame=5, randomness=0.0)
    assert tracking.task.params["ranges"].tolist() == [[0, episode.steps + 1]]
    torch.testing.assert_close(tracking.field("qpos")[0].double(), episode.part("qpos")[5], atol=1e-5, rtol=0.0)
