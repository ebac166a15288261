"""The command line, called as a shell would."""

import csv
import dataclasses
import inspect
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import mujoco
import pytest
import torch
import warp as wp
from conftest import TaskFile

import lyceum_warp as lw
from lyceum_warp import cli
from lyceum_warp.algos.distributed import Team
from lyceum_warp.algos.npg import MEAN_SEED
from lyceum_warp.binding.registry import find_task, task_names
from lyceum_warp.cli import display as report
from lyceum_warp.cli.arguments import Interrupted, parameter, postponed, signals, spelled
from lyceum_warp.cli.train import Train, _config
from lyceum_warp.runs import Run, load

TINY = ["--samples", "512", "--nworld", "2", "--hidden", "8", "--value-hidden", "8", "--mean-every", "2",
        "--mean-episodes", "2"]  # fmt: skip
QUIET = ["--no-video", "--no-plot"]


def train(out: Path, *options: str, task: str = "point_mass") -> int:
    return cli.main(["train", task, "--out", str(out), *TINY, *QUIET, *options])


def table(run: Path) -> list[dict[str, str]]:
    """The metrics without what clocks say."""
    with (run / "metrics.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    return [{k: v for k, v in row.items() if "time" not in k and k != "samples_per_second"} for row in rows]


def refused(capsys: pytest.CaptureFixture[str], *words: str) -> None:
    """One line on stderr, and it says these words."""
    error = capsys.readouterr().err
    assert error.startswith("lyceum-warp: ")
    assert error.count("\n") == 1
    for word in words:
        assert word in error


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "four"
    assert train(out, "--iterations", "4") == 0
    return out


def test_tasks(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["tasks"]) == 0
    out = capsys.readouterr().out
    line = next(line for line in out.splitlines() if "hopper" in line)
    assert line.split()[:7] == ["hopper", "11", "3", "4", "0.008", "s", "1000"]
    assert "hop forward on one leg" in line
    assert all(name in out for name in task_names())


@pytest.mark.parametrize("command", [[], ["train"], ["eval"]])
def test_help(command: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        cli.main([*command, "--help"])
    assert ended.value.code == 0
    out = capsys.readouterr().out
    assert "$ lyceum-warp" in out  # an example
    if command == ["train"]:
        assert all(f"--{name}" in out for name in ("iterations", "resume", "gamma", "value-hidden", "require-return"))
        assert all(f"--{name}" in out for name in ("integrator", "solver", "deterministic"))
        assert "Discount." in out


def test_train_and_eval_a_task_of_ones_own(
    task_file: TaskFile, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    source = Path(inspect.getfile(find_task("point_mass"))).read_text()
    source = source.replace("@lw.register\n", "").replace("PointMass", "Mine").replace("horizon = 256", "horizon = 20")
    mine = task_file("mine.py", source)
    monkeypatch.chdir(tmp_path)
    options = ["--iterations", "2", "--param", "success_distance=0.1", "--seed", "5"]
    assert cli.main(["train", os.path.relpath(mine), "--out", "deep/run", *TINY, *options]) == 0
    told = capsys.readouterr().out
    out = Path("deep/run")
    assert "iteration    2/2" in told
    assert f"checkpoint: {out / 'checkpoint.pt'}" in told
    for name, file in (("curve", out / "curve.png"), ("video", out / "video.mp4")):
        assert f"{name}:      {file if file.exists() else 'none: '}" in told
    config = Run.open(out).config
    assert (config["task"], config["seed"]) == (str(mine.resolve()), 5)
    assert config["params"] == {"success_distance": 0.1}
    assert config["npg"]["hidden"] == [8]
    rows = table(out)
    assert [row["iteration"] for row in rows] == ["1", "2"]
    assert [bool(row["mean_return"]) for row in rows] == [False, True]
    monkeypatch.chdir("/")  # the task is found from another folder, too
    assert cli.main(["eval", str(tmp_path / out), "--episodes", "2", "--video"]) == 0
    video = tmp_path / out / "eval.mp4"
    assert f"video: {video if video.exists() else 'none: '}" in capsys.readouterr().out


def test_a_resumed_run_equals_an_uninterrupted_one(
    trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    assert train(out, "--iterations", "2") == 0
    # an iteration whose checkpoint was never written
    with (out / "metrics.csv").open("a") as file:
        file.write(",".join(["3", *["1"] * 26]) + "\n4,")
    assert cli.main(["train", "--resume", str(out), "--iterations", "4", *QUIET]) == 0
    assert "iteration    3/4" in capsys.readouterr().out
    assert table(out) == table(trained)
    one, other = Run.open(out).read()["state"], Run.open(trained).read()["state"]
    assert torch.equal(one["env"], other["env"])
    assert torch.equal(one["generator"], other["generator"])
    assert all(torch.equal(one["policy"][name], other["policy"][name]) for name in one["policy"])
    assert all(torch.equal(one["value"][name], other["value"][name]) for name in one["value"])
    assert Run.open(out).config == Run.open(trained).config


def test_resume_refuses(trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    resume = ["train", "--resume", str(trained), *QUIET]
    before = {path: path.read_bytes() for path in trained.iterdir()}
    for options, words in [
        (["--iterations", "4"], ["has 4 iterations already", "--iterations 8"]),
        (["--iterations", "9", "--gamma", "0.9"], ["has gamma 0.995, not 0.9", "without --resume"]),
        (["--iterations", "9", "--seed", "1"], ["has seed 0, not 1"]),
        (["--iterations", "9", "--param", "success_distance=1"], ["has param"]),
        (["--iterations", "9", "--out", str(tmp_path)], ["stays in its folder"]),
    ]:
        assert cli.main([*resume, *options]) == 2
        refused(capsys, *words)
    assert before == {path: path.read_bytes() for path in trained.iterdir()}
    assert cli.main(["train", "--resume", str(tmp_path / "none")]) == 2
    refused(capsys, "there is no run in")


def physics(env: lw.Env) -> tuple[int, int, int, bool]:
    opt = env.model.opt
    return opt.integrator, opt.iterations, opt.ls_iterations, env._options["deterministic"]


def test_a_run_keeps_its_physics(tmp_path: Path, made_envs: list[lw.Env], capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "run"
    options = ["--integrator", "euler", "--solver", "iterations=7", "--solver", "ls_iterations=9", "--deterministic"]
    assert train(out, "--iterations", "1", *options, task="hopper") == 0  # whose own integrator is RK4
    solver = {"iterations": 7, "ls_iterations": 9}
    given = {"integrator": "euler", "solver": solver, "deterministic": True, "unroll": False}
    assert Run.open(out).config["physics"] == given
    resume = ["train", "--resume", str(out), *QUIET, "--iterations"]
    assert cli.main([*resume, "2"]) == 0
    assert cli.main([*resume, "3", "--solver", "iterations=7", "--integrator", "euler"]) == 0
    assert cli.main(["eval", str(out), "--episodes", "2", "--video"]) == 0
    assert {physics(env) for env in made_envs} == {(mujoco.mjtIntegrator.mjINT_EULER, 7, 9, True)}
    assert {env.nworld for env in made_envs} == {1, 2, 32}  # a video, all iterations and eval, the report
    capsys.readouterr()
    for other, words in [
        (["--integrator", "rk4"], "has integrator euler, not rk4"),
        (["--solver", "iterations=8"], "has solver {'iterations': 7, 'ls_iterations': 9}, not {'iterations': 8,"),
        (["--no-deterministic"], "has deterministic True, not False"),
    ]:
        assert cli.main([*resume, "4", *other]) == 2
        refused(capsys, words, "without --resume")


def test_a_run_from_before_there_was_a_choice_of_physics(
    trained: Path, tmp_path: Path, made_envs: list[lw.Env], capsys: pytest.CaptureFixture[str]
) -> None:
    for path in trained.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    config = Run.open(trained).config
    del config["physics"]
    (tmp_path / "config.json").write_text(json.dumps(config))
    resume = ["train", "--resume", str(tmp_path), "--iterations", "5", *QUIET]
    assert cli.main([*resume, "--integrator", "rk4"]) == 2
    refused(capsys, "has integrator None, not rk4")
    assert cli.main(resume) == 0
    assert cli.main(["eval", str(tmp_path), "--episodes", "2"]) == 0
    assert {physics(env) for env in made_envs} == {physics(lw.make("point_mass"))}


def test_resume_from_a_broken_checkpoint(trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("config.json", "metrics.csv", "versions.json"):
        (tmp_path / name).write_bytes((trained / name).read_bytes())
    whole = (trained / "checkpoint.pt").read_bytes()
    (tmp_path / "checkpoint.pt").write_bytes(whole[:-1000])
    resume = ["train", "--resume", str(tmp_path), "--iterations", "5", *QUIET]
    assert cli.main(resume) == 2
    refused(capsys, str(tmp_path / "checkpoint.pt"), "cut off", "restore the file from a copy")
    config = (tmp_path / "config.json").read_text()
    (tmp_path / "config.json").write_text(config.replace('"nworld": 2', '"nworld": 3'))
    (tmp_path / "checkpoint.pt").write_bytes(whole)
    assert cli.main(resume) == 2
    refused(capsys, "does not fit the configuration beside it")
    (tmp_path / "config.json").write_text(config.replace('"nworld": 2', '"nworld": "many"'))
    assert cli.main(["train", "--resume", str(tmp_path), "--iterations", "9"]) == 2
    refused(capsys, "config.json is not the configuration of an NPG run (nworld is 'many')")
    assert (tmp_path / "metrics.csv").read_bytes() == (trained / "metrics.csv").read_bytes()


def test_train_refuses_to_overwrite(trained: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = {path: path.read_bytes() for path in trained.iterdir()}
    assert train(trained, "--iterations", "9") == 2
    refused(capsys, str(trained), "--resume", "another --out")
    assert before == {path: path.read_bytes() for path in trained.iterdir()}


@pytest.mark.parametrize(
    "task, options, words",
    [
        ("point_mas", [], ["no task 'point_mas'", "did you mean point_mass?"]),
        ("nowhere.py", [], ["no task file 'nowhere.py'"]),
        ("point_mass", ["--engine", "bullet"], ["no engine 'bullet'", "'mujoco'"]),
        ("point_mass", ["--device", "cuda:77"], ["no device 'cuda:77'"]),
        ("point_mass", ["--nworld", "0"], ["nworld", "not 0"]),
        ("point_mass", ["--threads", "0"], ["threads", "not 0"]),
        ("point_mass", ["--iterations", "0"], ["iterations", "not 0"]),
        ("point_mass", ["--seed", "-1"], ["seed", "-1"]),
        ("point_mass", ["--gamma", "1.5"], ["gamma", "not 1.5"]),
        ("point_mass", ["--param", "distance=1"], ["no parameter 'distance'"]),
        ("point_mass", ["--param", "success_distance"], ["NAME=VALUE", "'success_distance'"]),
        ("point_mass", ["--param", "success_distance="], ["NAME=VALUE"]),
        ("point_mass", ["--param", "success_distance=near"], ["'success_distance=near' is no number"]),
        ("point_mass", ["--integrator", "rk5"], ["no integrator 'rk5'", "'euler'"]),
        ("point_mass", ["--solver", "iteration=3"], ["no limit 'iteration'", "'iterations'"]),
        ("point_mass", ["--solver", "iterations=0"], ["solver's iterations", "not 0"]),
        ("point_mass", ["--solver", "iterations"], ["'iterations' has to be written as NAME=VALUE"]),
    ],
)
def test_bad_input_is_one_line_and_leaves_no_folder(
    task: str, options: list[str], words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert train(tmp_path / "run", *options, task=task) == 2
    refused(capsys, *words)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    "argv", [["train", "hopper", "--samples", "many"], ["train", "hopper", "--speed", "2"], ["jump"]]
)
def test_unknown_options_and_commands(argv: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        cli.main(argv)
    assert ended.value.code == 2
    assert "Traceback" not in capsys.readouterr().err


def test_train_without_a_task(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["train"]) == 2
    refused(capsys, "train needs a task", "hopper")


def test_require_return(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert train(tmp_path / "easy", "--iterations", "1", "--require-return", "-1e6") == 0
    assert train(tmp_path / "hard", "--iterations", "1", "--require-return", "1e6") == 1
    assert "--require-return asks for more than 1e+06" in capsys.readouterr().err
    assert (tmp_path / "hard" / "checkpoint.pt").exists()


def test_a_run_of_a_gpu_is_evaluated_anywhere(
    trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    shutil.copytree(trained, run)
    config = json.loads((run / "config.json").read_text())
    config |= {"device": "cuda:7", "params": config["params"] | {"nconmax": 16}}
    (run / "config.json").write_text(json.dumps(config))
    assert cli.main(["eval", str(run), "--episodes", "2"]) == 0
    assert "2 episodes of the mean policy" in capsys.readouterr().out
    assert cli.main(["eval", str(run), "--episodes", "2", "--engine", "warp"]) == 2
    assert "no device 'cuda:7'" in capsys.readouterr().err


def test_eval(trained: Path, capsys: pytest.CaptureFixture[str]) -> None:
    answers = []
    for seed in ("7", "7", "8"):
        assert cli.main(["eval", str(trained), "--episodes", "3", "--seed", seed, "--nworld", "2"]) == 0
        answers.append(capsys.readouterr().out)
    assert answers[0] == answers[1] != answers[2]
    assert "3 episodes of the mean policy" in answers[0]
    lines = {line.split()[0]: line.split() for line in answers[0].splitlines() if line.split()}
    assert lines["length"] == ["length", "256", "0", "256", "256"]
    mean, std, low, high = (float(number) for number in lines["return"][1:])
    assert low <= mean <= high
    assert std > 0
    assert "success:" in lines
    assert cli.main(["eval", str(trained), "--episodes", "0"]) == 2
    refused(capsys, "at least 1 episode")
    assert cli.main(["eval", str(trained.parent)]) == 2
    refused(capsys, "there is no run in")


def test_the_loaded_policy_is_the_trained_one(trained: Path) -> None:
    policy = load(trained)
    env = lw.make("point_mass", nworld=2)
    episodes = lw.evaluate(env, policy, 2, seed=MEAN_SEED)
    assert repr(episodes.returns.mean().item()) == table(trained)[-1]["mean_return"]


def interrupted(argv: list[str]) -> int:
    """The exit code of a command that gets a SIGINT as it runs: one that is not heard is no end of all tests."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        return cli.main(argv)
    except KeyboardInterrupt:
        pytest.fail("SIGINT was left to Python")
    finally:
        signal.signal(signal.SIGINT, before)


def check_goes_on(out: Path, said: str, trained: Path) -> None:
    """A run that was ended after its third iteration has lost nothing, and says how to go on."""
    done = Run.open(out).read()["iteration"]
    assert f"after {done} of 100000 iterations" in said
    assert f"lyceum-warp train --resume {out} --iterations 100000" in said
    rows = table(out)
    assert [int(row["iteration"]) for row in rows] == list(range(1, done + 1))
    assert rows[:3] == table(trained)[:3]
    assert cli.main(["train", "--resume", str(out), "--iterations", str(done + 1), *QUIET]) == 0
    assert len(table(out)) == done + 1


def test_a_terminated_run_goes_on(trained: Path, tmp_path: Path) -> None:
    if os.name == "nt":
        pytest.skip("signals are POSIX's")
    out = tmp_path / "run"
    argv = ["train", "point_mass", "--out", str(out), *TINY, *QUIET, "--iterations", "100000"]
    program = f"import sys; from lyceum_warp.cli import main; sys.exit(main({argv!r}))"
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if "iteration    3/" in line:
                process.send_signal(signal.SIGTERM)
                break
        rest = process.stdout.read()
    assert process.returncode == 143
    check_goes_on(out, rest, trained)


def test_an_interrupted_run_goes_on(
    trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Within this process; what plans, and ends as a whole, is interrupted from outside in test_cli_plan."""
    out = tmp_path / "run"
    save = Run.save

    def interrupting(run: Run, iteration: int, *args: Any) -> None:
        save(run, iteration, *args)
        if iteration == 3:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(Run, "save", interrupting)
    argv = ["train", "point_mass", "--out", str(out), *TINY, *QUIET, "--iterations", "100000"]
    assert interrupted(argv) == 130
    monkeypatch.undo()
    check_goes_on(out, capsys.readouterr().out, trained)


def test_a_killed_run_goes_on(trained: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    argv = ["train", "point_mass", "--out", str(out), *TINY, *QUIET, "--iterations", "100000"]
    program = f"import sys; from lyceum_warp.cli import main; sys.exit(main({argv!r}))"
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.DEVNULL) as process:
        limit = time.monotonic() + 60
        while not (out / "metrics.csv").exists() or len(table(out)) < 2:
            assert process.poll() is None and time.monotonic() < limit
            time.sleep(0.01)
        process.kill()
    total = max(4, Run.open(out).read()["iteration"] + 1)
    assert cli.main(["train", "--resume", str(out), "--iterations", str(total), *QUIET]) == 0
    assert table(out)[:4] == table(trained)[:4]
    assert len(table(out)) == total


def test_a_postponed_signal_is_not_forgotten() -> None:
    """One that nobody asked about is raised at the end; once it is raised, a second one disturbs nobody."""
    before = signal.signal(signal.SIGTERM, signal.SIG_DFL)
    try:
        with signals():
            with pytest.raises(Interrupted) as raised, postponed() as noted:
                signal.raise_signal(signal.SIGTERM)
                signal.raise_signal(signal.SIGINT)
                assert noted == [signal.SIGTERM, signal.SIGINT]
            assert raised.value.number == signal.SIGTERM
            signal.raise_signal(signal.SIGTERM)
        with signals():
            with pytest.raises(Interrupted), postponed() as noted:
                signal.raise_signal(signal.SIGTERM)
                raise Interrupted(max(noted))
            signal.raise_signal(signal.SIGTERM)
        with signals():
            with postponed():
                pass
            with pytest.raises(Interrupted), postponed(False) as noted:
                signal.raise_signal(signal.SIGTERM)
            assert noted == []
    finally:
        signal.signal(signal.SIGTERM, before)


def test_signals_are_left_as_they_were(trained: Path) -> None:
    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    cli.main(["tasks"])
    assert before == (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM))


@pytest.mark.parametrize("text, value", [
    ("a=1", 1), ("a=-0.5", -0.5), ("a=1e-3", 1e-3), ("a=inf", float("inf")), ("a=true", True), ("a=False", False),
    ("a=0.7,inf", [0.7, float("inf")]), ("a=[1, 2]", [1, 2]),
])  # fmt: skip
def test_parameters(text: str, value: object) -> None:
    name, parsed = parameter(text)
    assert (name, parsed) == ("a", value)
    assert type(parsed) is type(value)
    assert parameter(f"a={spelled(parsed)}") == ("a", value)


def test_the_table_is_short() -> None:
    rows = [{"iteration": float(i), "mean_return": None} for i in range(1, 101)]
    shown = report._spread(rows)
    assert len(shown) == 15
    assert (shown[0], shown[-1]) == (rows[0], rows[-1])
    for i in range(9, 100, 10):
        rows[i]["mean_return"] = 1.0
    assert [row["iteration"] for row in report._spread(rows)] == [1, *range(10, 101, 10)]


def test_as_many_worlds_as_the_device_is_good_for() -> None:
    options = Train(task="hopper")
    found = []
    for device, size, given in (("cpu", 2, None), ("cuda:0", 1, None), ("cuda", 2, None), ("cuda", 2, 96)):
        config = _config(dataclasses.replace(options, device=device, nworld=given), Team(0, size))
        found.append((config["nworld"], config["npg"]["samples"]))
    assert found == [(64, 10_000), (4096, 65_536), (8192, 131_072), (96, 10_000)]


@pytest.mark.gpu
def test_train_on_a_gpu(tmp_path: Path) -> None:
    assert wp.is_cuda_available()
    assert train(tmp_path / "run", "--device", "cuda", "--iterations", "2") == 0
    assert cli.main(["eval", str(tmp_path / "run"), "--episodes", "2", "--device", "cpu"]) == 0


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out == f"lyceum-warp {lw.__version__}\n"
