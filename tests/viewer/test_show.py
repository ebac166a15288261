import re
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from conftest import SharedEnv
from training_runs import train
from websockets.sync.client import connect

import lyceum_warp as lw
from lyceum_warp.training import Run
from lyceum_warp.training.runs.checkpoints import policy_content, write_content
from lyceum_warp.viewer import Follower


def test_show_displays_the_page_and_a_link_in_a_notebook_while_the_worlds_run(
    shared_env: SharedEnv, monkeypatch: pytest.MonkeyPatch
) -> None:
    shell = SimpleNamespace(kernel=object())
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(get_ipython=lambda: shell))
    env = shared_env("point_mass", nworld=2)
    shown = lw.view(env, seed=0)
    assert shown is not None
    address = shown.address.replace("http", "ws", 1)
    with connect(f"{address}state?sid=a"), connect(f"{address}ui?sid=a") as page:
        page.send(b"x")  # the worlds run while a page is visible; a whole handshake would need its version
        end = time.monotonic() + 60
        while env.episode_step[0] == 0 and time.monotonic() < end:
            time.sleep(0.01)
    assert shown.is_open and env.episode_step[0] > 0
    link = r'<a id="([\w-]+)" href="http://127\.0\.0\.1:\d+/[\w-]{43}/" target="_blank">.*getElementById\("\1"\)'
    assert re.search(link, shown._repr_html_(), re.DOTALL) and 'createElement("iframe")' in shown._repr_html_()
    shown.close()
    shown.close()
    assert not shown.is_open and shown._repr_html_() == "viewer of point_mass (closed)"
    before = env.episode_step.clone()
    env.step()
    assert (env.episode_step == before + 1).all()


def test_viewer_of_a_run_loads_the_newest_policy_and_reports_an_unreadable_one(tmp_path: Path) -> None:
    assert train(tmp_path / "run", "--iterations", "1") == 0
    run = Run.open(tmp_path / "run")
    follower, newest = Follower(run, lw.load(run)), lw.load(run)
    assert follower() == ["policy of iteration 1"] and follower() == []
    obs = torch.randn(4, newest.nobs)
    with torch.no_grad():
        for parameter in newest.parameters():
            parameter += 0.1
        write_content(run.policy, policy_content(2, newest, None))
        assert follower() == ["policy of iteration 2"]
        assert torch.equal(follower.policy(obs), newest(obs))
    run.policy.write_bytes(b"half a file")
    (message,) = follower()
    assert "was not read" in message and "\n" not in message
    assert follower() == []
