from pathlib import Path

import torch
from training_runs import train

import lyceum_warp as lw
from lyceum_warp.training import Run
from lyceum_warp.training.runs.checkpoints import policy_content, write_content
from lyceum_warp.viewer import Follower


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
