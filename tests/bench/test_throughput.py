import json
from pathlib import Path
from typing import Any

import experiment
import plot
import pytest
import throughput

BENCH = Path(__file__).parents[2] / "bench"


def run(name: str, out: Path, *words: str) -> int:
    return experiment.main(experiment.load(name), ["--short", "--out", str(out), *words])


def lines(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def test_throughput_is_measured_once_and_written_as_a_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "throughput.jsonl"
    words = (
        "--tasks cartpole --contestants native c gymnasium gym-sync --threads 1 --parts sampling single kept".split()
    )
    assert run("throughput", out, *words) == 0
    rows = lines(out)
    cases = {(row["case"]["part"], row["case"]["contestant"]): row for row in rows}
    sampling = {("sampling", name) for name in ("native", "c", "gym-sync")}
    assert cases.keys() == sampling | {("single", "gymnasium"), ("single", "c"), ("kept", "c")}
    assert all(row["result"]["env_steps_per_second"] > 0.0 for row in rows)
    assert {row["case"]["worlds"] for row in rows if row["case"]["part"] == "single"} == {1}
    assert cases["kept", "c"]["result"]["kept"] > 0.0
    native, ours = (cases["sampling", name]["result"]["env_steps_per_second"] for name in ("native", "c"))
    printed = capsys.readouterr().out
    assert f"| {ours:,.0f}; {ours / native:.2f} |" in printed
    assert "| task | native C | lyceum_warp, C engine | Gymnasium, SyncVectorEnv |" in printed
    assert "| task | Gymnasium | lyceum_warp, C engine |" in printed and "| cartpole | C | 64 |" in printed
    assert run("throughput", out, *words) == 0 and len(lines(out)) == len(rows)
    assert "6 of 6 cases are stored" in capsys.readouterr().out

    assert plot.main(experiment.Stored(("throughput",), tmp_path)) == 0
    assert len([*tmp_path.glob("throughput-*.png")]) == 1


def test_every_library_is_measured_on_several_numbers_of_cores_and_worlds() -> None:
    words = {"tasks": ("cartpole",), "contestants": ("native", "c"), "threads": 2, "parts": ("cores", "worlds")}
    cases = throughput.cases(throughput.Options(short=True, **words))
    found = [(case.part, case.contestant, case.worlds, case.threads) for case in cases]
    cores = [("cores", name, 64 * threads, threads) for name in ("native", "c") for threads in (1, 2)]
    assert found == [*cores, *(("worlds", "c", many, 2) for many in (1, 8, 64))]


def test_dm_control_tasks_are_measured_with_equal_numbers_of_worlds_by_every_library() -> None:
    options = throughput.Options(parts=("suite",), tasks=("dm/cheetah_run", "dm/quadruped_walk"), threads=2, repeats=1)
    found = [(case.task, case.worlds, case.contestant) for case in throughput.cases(options)]
    assert found.count(("dm/cheetah_run", 16, "envpool")) == 1 and len(found) == 3 * (3 + 2)
    assert ("dm/quadruped_walk", 16, "envpool") not in found
    assert {case.threads for case in throughput.cases(options)} == {2}


@pytest.mark.parametrize("task", ["cartpole", "herb_reach"])
def test_gymnasium_tasks_return_the_observations_and_rewards_of_lyceum_warp(
    task: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(BENCH / "peers" / "environments"))
    import gymnasium
    import numpy as np
    import python_tasks
    import torch

    import lyceum_warp as lw

    env = lw.make(task, engine="mujoco", seed=3, fields=["mocap_pos"])
    other = gymnasium.make(python_tasks.GYMNASIUM[task])
    first, _ = other.reset(seed=3)
    assert first.shape == tuple(env.obs.shape[1:]) and other.action_space.shape == tuple(env.action.shape[1:])
    raw = other.unwrapped
    raw.data.mocap_pos[:] = env.field("mocap_pos")[0]
    raw.set_state(env.field("qpos")[0].double().numpy(), env.field("qvel")[0].double().numpy())
    random = np.random.default_rng(0)
    for _ in range(20):
        action = random.uniform(other.action_space.low, other.action_space.high).astype(np.float32)
        obs, reward, terminated, *_ = other.step(action)
        env.step(torch.from_numpy(action)[None])
        np.testing.assert_allclose(env.obs[0], obs, atol=2e-4, rtol=2e-4)
        assert env.reward.item() == pytest.approx(reward, abs=1e-4) and not terminated
