from pathlib import Path

import torch
from training_runs import train

import lyceum_warp as lw
from lyceum_warp.runs.checkpoints import policy_content, write_content
from lyceum_warp.runs.folder import Run
from lyceum_warp.viewer.follow import Follower


def test_viewer_of_a_run_loads_the_newest_policy(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    npg = lw.NPG(lw.make("point_mass", nworld=2), config=lw.NPGConfig(samples=512, hidden=(8,), value_hidden=(8,)))
    followers: list[Follower] = []

    def callback(iteration: lw.Iteration) -> None:
        if not followers:
            run = Run.open(folder)
            followers.append(Follower(run, lw.load(run)))
        # this run saves only some policies, because its iterations are short
        write_content(folder / "policy.pt", policy_content(npg.iteration, npg.policy, npg.value))
        assert followers[0]() == [f"policy of iteration {iteration.iteration}"]

    lw.train(npg, folder, iterations=3, callback=callback)
    assert followers[0]() == ["policy of iteration 3"] and followers[0]() == []
    obs = torch.randn(4, npg.policy.nobs)
    with torch.no_grad():
        assert torch.equal(followers[0].policy(obs), npg.policy(obs))


def test_viewer_of_a_run_reports_an_unreadable_policy_as_a_message(tmp_path: Path) -> None:
    assert train(tmp_path / "run", "--iterations", "1") == 0
    run = Run.open(tmp_path / "run")
    follower = Follower(run, lw.load(run))
    (tmp_path / "run" / "policy.pt").write_bytes(b"half a file")
    (message,) = follower()
    assert "was not read" in message and "\n" not in message
    assert follower() == []
