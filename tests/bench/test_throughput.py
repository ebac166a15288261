"""The experiments throughput and scaling, with the smallest cases."""

import json
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

import lyceum_warp as lw
from lyceum_warp.runs.checkpoints import policy_content, write_content

BENCH = Path(__file__).parents[2] / "bench"


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(BENCH))
    import experiment

    return experiment


def run(bench: ModuleType, name: str, out: Path, *words: str) -> int:
    return bench.main(bench.load(name), ["--short", "--out", str(out), *words])


def lines(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def test_throughput_is_measured_once_and_tabulated(
    bench: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "throughput.jsonl"
    words = "--tasks cartpole --contestants native c gymnasium gym-sync --threads 1".split()
    assert run(bench, "throughput", out, *words) == 0
    rows = lines(out)
    cases = {(row["case"]["part"], row["case"]["contestant"]): row for row in rows}
    sampling = {("sampling", name) for name in ("native", "c", "gym-sync")}
    assert cases.keys() == sampling | {("single", "gymnasium"), ("single", "c"), ("kept", "c")}
    assert all(row["result"]["env_steps_per_second"] > 0.0 for row in rows)
    assert {row["case"]["worlds"] for row in rows if row["case"]["part"] == "single"} == {1}
    assert cases["kept", "c"]["result"]["kept"] > 0.0
    printed = capsys.readouterr().out
    assert "| task | native C | ours, C engine | Gymnasium, SyncVectorEnv |" in printed
    assert "| task | Gymnasium | ours, C engine |" in printed and "| cartpole | C | 64 |" in printed
    assert run(bench, "throughput", out, *words) == 0 and len(lines(out)) == len(rows)
    assert "6 of 6 cases are there" in capsys.readouterr().out

    import plot

    assert plot.main(plot.Options(("throughput",), tmp_path)) == 0
    assert len([*tmp_path.glob("throughput-*.svg")]) == 1


def test_actions_of_a_policy_are_stepped_beside_the_bare_engine(
    bench: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    env = lw.make("cartpole", nworld=2)
    npg = lw.NPG(env, config=lw.NPGConfig(samples=64, mean_every=0))
    policy, out = tmp_path / "policy.pt", tmp_path / "throughput.jsonl"
    write_content(policy, policy_content(0, npg.policy, npg.value))
    words = f"--tasks cartpole --contestants c --threads 1 --parts kept --worlds 16 --policy {policy}".split()
    assert run(bench, "throughput", out, *words) == 0
    (row,) = lines(out)
    assert row["case"]["policy"] == str(policy) and row["result"]["kept"] > 0.0
    assert "| cartpole, of a policy | C | 16 |" in capsys.readouterr().out

    import plot

    assert plot.main(plot.Options(("throughput",), tmp_path)) == 0
    assert not [*tmp_path.glob("*.svg")]  # nothing to compare


def test_scaling_is_measured_by_cores_and_worlds(
    bench: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "scaling.jsonl"
    words = "--tasks cartpole --contestants native c gym-async --threads 1 --worlds 1 16".split()
    assert run(bench, "scaling", out, *words) == 0
    found = [(row["case"]["part"], row["case"]["contestant"], row["case"]["worlds"]) for row in lines(out)]
    cores = [("cores", "native", 64), ("cores", "c", 64), ("cores", "gym-async", 2)]
    assert found == [*cores, ("worlds", "c", 1), ("worlds", "c", 16)]
    printed = capsys.readouterr().out
    assert "| threads | native C | ours, C engine | Gymnasium, AsyncVectorEnv |" in printed
    assert "| 90% of the highest rate from | 16 |" in printed
    rates = {row["case"]["contestant"]: row["result"]["env_steps_per_second"] for row in lines(out)[:3]}
    ratios = [f"{rates[name] / rates['native']:.2f}" for name in ("c", "gym-async")]
    assert f"| 1 | {' | '.join(ratios)} |" in printed

    import plot

    assert plot.main(plot.Options(("scaling",), tmp_path)) == 0
    assert len([*tmp_path.glob("scaling-*.png")]) == 1


def test_missing_peers_are_skipped_with_one_line(
    bench: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    import peers

    monkeypatch.setenv("LYCEUM_WARP_PEERS", str(tmp_path / "peers"))
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    for cached in (peers.peer, peers._failure):
        cached.cache_clear()
    out = tmp_path / "throughput.jsonl"
    words = "--tasks cartpole --contestants dm_control --threads 1 --parts sampling single".split()
    assert run(bench, "throughput", out, *words) == 0
    assert capsys.readouterr().out.count("skipped: dm_control cannot be installed: ") == 1 and not out.exists()
    for cached in (peers.peer, peers._failure):
        cached.cache_clear()


def test_more_threads_than_cores_are_skipped(
    bench: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = "--tasks cartpole --contestants c --threads 4096 --parts cores".split()
    assert run(bench, "scaling", tmp_path / "scaling.jsonl", *words) == 0
    assert "skipped: 4096 threads need as many cores" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--tasks hoper", "throughput: there is no task 'hoper': did you mean hopper?"),
        ("--contestants gym", "throughput: there is no contestant 'gym': there are native, c, warp, "),
        ("--parts one", "throughput: there is no part 'one': there are sampling, single, kept"),
        ("--policy none.pt", "throughput: --policy none.pt belongs to one task: name it with --tasks"),
        ("--policy none.pt --tasks hopper", "throughput: there is no policy none.pt: give the folder of a run"),
        ("--device cuda:7", "throughput: there is no GPU for --device cuda:7"),
    ],
)
def test_bad_input_gets_one_line(
    words: str, message: str, bench: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    import torch

    if "cuda" in words and torch.cuda.is_available():
        pytest.skip("there is a GPU")
    assert run(bench, "throughput", tmp_path / "out.jsonl", *words.split()) == 2
    captured = capsys.readouterr()
    assert captured.err.startswith(message) and captured.err.count("\n") == 1


def test_all_of_gymnasiums_mujoco_tasks_are_compared(bench: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(BENCH / "peers" / "environments"))
    import gymnasium
    import python_tasks
    import sampling
    import throughput

    theirs = {
        name for name, spec in gymnasium.registry.items()
        if name.endswith("-v5") and str(spec.entry_point).startswith("gymnasium.envs.mujoco")
    }  # fmt: skip
    assert len(theirs) == 11 and theirs <= {python_tasks.GYMNASIUM[task] for task in throughput.TASKS}
    assert theirs <= {sampling.ENVPOOL.get(task) for task in throughput.TASKS}


@pytest.mark.parametrize("task", ["cartpole", "herb_reach"])
def test_python_tasks_are_ours(task: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Gymnasium's version of a task, from our states under our actions, returns our observations and rewards."""
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
