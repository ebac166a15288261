import json
import re
import shutil
import signal
from pathlib import Path

import mujoco
import pytest
import tiny_task
import torch
from conftest import TaskFile
from training_runs import QUIET, TINY, interrupted, metrics, refused, train

import lyceum_warp as lw
from lyceum_warp import cli
from lyceum_warp.algos import Team
from lyceum_warp.cli.arguments import EnvFlags, given
from lyceum_warp.cli.train import Hyperparameters, Train
from lyceum_warp.training import ALGORITHMS, Run, load
from lyceum_warp.viz import policy_videos


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "four"
    assert train(out, "--iterations", "4") == 0
    return out


def test_train_and_eval_accept_a_task_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = tiny_task.changed(("dt: float", "dt: float\n    gain: float = 1.0"), ("class Tiny", "class Mine"))
    mine = tiny_task.write(tmp_path, f"{source}    horizon = 20\n", "mine.py")
    monkeypatch.chdir(tmp_path)
    options = ["--iterations", "2", "--param", "gain=0.1", "--seed", "5"]
    assert cli.main(["train", "mine.py", "--out", "deep/run", *TINY, *options]) == 0
    out = Path("deep/run")
    config = Run.open(out).config
    assert (config["task"], config["seed"]) == (f"{mine.resolve()}:Mine", 5)
    assert config["params"] == {"gain": 0.1}
    assert config["npg"]["hidden"] == [8]
    rows = metrics(out)
    assert [row["iteration"] for row in rows] == ["1", "2"]
    assert [bool(row["mean_return"]) for row in rows] == [False, True]
    assert (out / "curve.png").stat().st_size > 1000
    monkeypatch.chdir("/")
    assert cli.main(["eval", str(tmp_path / out), "--episodes", "2"]) == 0


def test_failed_video_prints_one_line_and_training_succeeds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(*args: object, **words: object) -> None:
        raise OSError(28, "No space left on\ndevice")

    monkeypatch.setattr(policy_videos, "write_video", fail)
    out = tmp_path / "run"
    options = [*TINY, "--horizon", "6", "--no-plot", "--iterations", "1", "--video", "--video-every", "1"]
    assert cli.main(["train", "point_mass", "--out", str(out), *options]) == 0
    shown = capsys.readouterr()
    assert "video:      none: [Errno 28] No space left on device" in shown.out.splitlines()
    assert "lyceum-warp: no further videos ([Errno 28] No space left on device)" in shown.err
    assert load(out) is not None


def test_resume_with_other_settings_prints_an_error(
    trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    resume = ["train", "--resume", str(trained), *QUIET]
    before = {path: path.read_bytes() for path in trained.iterdir()}
    for options, words in [
        (["--iterations", "4"], ["already has 4 iterations", "--iterations 8"]),
        (["--iterations", "9", "--gamma", "0.9"], ["gamma 0.995, not 0.9", "start a new run in another folder"]),
        (["--iterations", "9", "--nworld", "4"], ["has nworld 2, not 4"]),
        (["--iterations", "9", "--param", "success_distance=1"], ["success_distance None, not 1"]),
        (["--iterations", "9", "--num-steps", "4"], ["--num-steps is a setting of ppo or sac or distill, not of npg"]),
        (["--iterations", "9", "--seed", "0"], ["--seed has no effect with --resume", "omit it"]),
        (["--iterations", "9", "--algorithm", "npg"], ["--algorithm has no effect with --resume"]),
        (["--iterations", "9", "--out", str(tmp_path)], ["--out has no effect with --resume"]),
        (["--iterations", "9", "cartpole"], ["has task point_mass, not cartpole"]),
        (["--iterations", "9", "--engine", "warp"], ["has engine mujoco, not warp"]),
    ]:
        assert cli.main([*resume, *options]) == 2
        refused(capsys, *words)
    assert before == {path: path.read_bytes() for path in trained.iterdir()}
    assert cli.main(["train", "--resume", str(tmp_path / "none")]) == 2
    refused(capsys, "there is no run in")


def test_resumed_run_uses_its_saved_tensorboard_and_video_settings(tmp_path: Path) -> None:
    out = tmp_path / "run"
    pytest.importorskip("tensorboard")
    assert train(out, "--iterations", "1", "--tensorboard", "--video-every", "50") == 0
    resume = ["train", "--resume", str(out), *QUIET, "--iterations"]
    assert cli.main([*resume, "2"]) == 0
    assert len(list(out.glob("events.out.tfevents.*"))) == 2
    config = Run.open(out).config
    assert (config["tensorboard"], config["video_every"]) == (True, 50)
    assert cli.main([*resume, "3", "--no-tensorboard", "--video-every", "0"]) == 0
    assert len(list(out.glob("events.out.tfevents.*"))) == 2
    config = Run.open(out).config
    assert (config.pop("tensorboard"), config.pop("video_every")) == (False, 0)
    (out / "config.json").write_text(json.dumps(config))  # as lw.train writes it without these callbacks
    assert cli.main([*resume, "4"]) == 0


def physics(env: lw.Env) -> tuple[int, int, int, bool]:
    opt = env.model.opt
    return opt.integrator, opt.iterations, opt.ls_iterations, env.options.physics.deterministic


def test_resumed_run_uses_its_saved_physics_and_environment_options(
    tmp_path: Path, made_envs: list[lw.Env], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(policy_videos, "write_video", lambda env, states, path, **options: path)
    out = tmp_path / "run"
    options = ["--integrator", "euler", "--solver", "iterations=7", "--solver", "ls_iterations=9", "--deterministic"]
    options += ["--horizon", "32", "--nthread", "2"]
    assert train(out, "--iterations", "1", *options, task="hopper") == 0
    resume = ["train", "--resume", str(out), *QUIET, "--iterations"]
    assert cli.main([*resume, "2", "--solver", "iterations=7", "--integrator", "euler"]) == 0
    assert cli.main(["eval", str(out), "--episodes", "2", "--video"]) == 0
    learning = [env for env in made_envs if env.nworld != 32]  # the verdict is in exact physics
    assert {physics(env) for env in learning} == {(mujoco.mjtIntegrator.mjINT_EULER, 7, 9, True)}
    assert {env.nworld for env in made_envs} == {1, 2, 32}
    assert {(env.horizon, env.options.nthread) for env in made_envs} == {(32, 2)}
    made_envs.clear()
    assert cli.main(["eval", str(out), "--episodes", "2", "--horizon", "16", "--nthread", "1"]) == 0
    assert {(env.horizon, env.options.nthread) for env in made_envs} == {(16, 1)}
    capsys.readouterr()
    for other, words in [
        (["--integrator", "rk4"], "integrator euler, not rk4"),
        (["--solver", "iterations=8"], "solver {'iterations': 7, 'ls_iterations': 9}, not {'iterations': 8,"),
    ]:
        assert cli.main([*resume, "4", *other]) == 2
        refused(capsys, words)


def test_named_physics_are_saved_as_options_and_eval_can_replace_them(
    tmp_path: Path, made_envs: list[lw.Env], task_file: TaskFile, capsys: pytest.CaptureFixture[str]
) -> None:
    line = "    physics = {'fast': lw.PhysicsOptions(integrator='euler', timestep=0.004, frame_skip=2)}\n"
    task = task_file("fast.py", tiny_task.changed(("    model", f"{line}    model")))
    out, short = tmp_path / "run", ("--horizon", "40")
    assert train(out, "--iterations", "1", "--physics", "fast", "--cone", "elliptic", *short, task=str(task)) == 0
    given = {"integrator": "euler", "timestep": 0.004, "frame_skip": 2, "cone": "elliptic"}
    assert Run.open(out).config["physics"] == given
    for flags, timestep in (([], 0.004), (["--physics", "exact"], 0.002)):
        assert cli.main(["eval", str(out), "--episodes", "1", *flags]) == 0
        assert made_envs[-1].model.opt.timestep == timestep
    capsys.readouterr()
    assert cli.main(["train", str(task), "--physics", "slow", "--out", str(tmp_path / "other")]) == 2
    refused(capsys, "there is no physics 'slow': use 'exact', 'fast'")
    assert not (tmp_path / "other").exists()


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_every_hyperparameter_has_a_flag(algorithm: str) -> None:
    _, config = ALGORITHMS[algorithm]
    assert {*vars(config())} <= {*vars(Hyperparameters())}
    assert given(Hyperparameters()) == {} and Hyperparameters().on_top_of(None, algorithm) == config()
    changed = Hyperparameters(mean_every=7, normalize=False)
    assert changed.on_top_of(config(hidden=(3,)), algorithm) == config(hidden=(3,), mean_every=7, normalize=False)


def test_damaged_best_policy_is_replaced_with_a_message(
    trained: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    best = Path(shutil.copytree(trained, tmp_path / "run")) / "best.pt"
    best.write_bytes(best.read_bytes()[:-1000])
    assert cli.main(["train", "--resume", str(tmp_path / "run"), "--iterations", "5", *QUIET]) == 0
    assert f"{best} is damaged" in capsys.readouterr().err


@pytest.mark.parametrize(
    "task, options, words",
    [
        ("", [], ["train needs a task", "hopper"]),
        ("point_mas", [], ["'point_mas'", "did you mean point_mass"]),
        ("point_mass", ["--device", "cuda:77"], ["'cuda:77'"]),
        ("point_mass", ["--threads", "0"], ["threads", "0"]),
        ("point_mass", ["--iterations", "0"], ["iterations", "0"]),
        ("point_mass", ["--algorithm", "rsl-rl"], ["'rsl-rl'", "npg, ppo, sac, distill or"]),
        ("point_mass", ["--gamma", "1.5"], ["gamma", "1.5"]),
        ("point_mass", ["--solver", "iterations"], ["'iterations'", "NAME=VALUE"]),
        ("point_mass", ["--learning-rate", "3"], ["--learning-rate", "ppo or sac", "npg"]),
        ("point_mass", ["--video-every", "1", "--camera", "side"], ["'side'"]),
        ("point_mass", ["--camera", "0"], ["--camera", "--video"]),
        ("point_mass", ["--video-every", "-1"], ["--video-every must be", "-1"]),
        ("point_mass", ["--gate-every", "-1"], ["--gate-every must be", "-1"]),
        ("point_mass", ["--take-over"], ["--take-over has no effect without --resume"]),
    ],
)
def test_invalid_option_prints_one_line_and_makes_no_folder(
    task: str, options: list[str], words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert train(tmp_path / "run", *options, task=task) == 2
    refused(capsys, *words)
    assert not (tmp_path / "run").exists()


def test_train_exits_with_1_if_the_return_is_below_require_return(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert train(tmp_path / "easy", "--iterations", "1", "--require-return", "-1e6") == 0
    assert "mean policy, 32 new episodes on the C engine, exact physics: return " in capsys.readouterr().out
    assert train(tmp_path / "hard", "--iterations", "1", "--require-return", "1e6") == 1
    assert "--require-return demands more than 1e+06" in capsys.readouterr().err
    assert (tmp_path / "hard" / "checkpoint.pt").exists()


def test_train_plays_no_episodes_at_the_end_unless_asked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name, flags, plays in (("quick", [], False), ("judged", ["--evaluate"], True)):
        assert train(tmp_path / name, "--iterations", "1", *flags) == 0
        out = capsys.readouterr().out
        assert ("mean policy, 32 new episodes" in out) == (tmp_path / name / "evaluation.json").exists() == plays
        assert (f"lyceum-warp eval {tmp_path / name}\n" in out) != plays


def test_default_number_of_worlds_depends_on_device_and_algorithm() -> None:
    for device, processes, algorithm, flag, nworld in [
        ("cpu", 2, "npg", None, 64), ("cuda:0", 1, "npg", None, 4096), ("cuda", 2, "npg", None, 8192),
        ("cuda", 2, "npg", 96, 96), ("cpu", 1, "sac", None, 8), ("cuda", 1, "sac", None, 4096),
    ]:  # fmt: skip
        train = Train(task="hopper", algorithm=algorithm, env=EnvFlags(device=device), nworld=flag)
        assert train.configuration(None, Team(0, processes)).options.nworld == nworld


def suggesting(folder: Path, training: str) -> str:
    return str(
        tiny_task.write(folder, tiny_task.changed(('obs = {"x": 1}', f'obs = {{"x": 1}}\n    training = {training}')))
    )


def test_flags_override_the_training_settings_that_a_task_suggests(tmp_path: Path) -> None:
    task = suggesting(tmp_path, 'lw.Training(algorithm="ppo", settings={"lam": 0.5, "gamma": 0.9}, iterations=7)')

    for flags, algorithm, iterations, hyperparameters in [
        ({}, "ppo", 7, lw.PPOConfig(lam=0.5, gamma=0.9)),
        ({"algorithm": "ppo", "hyperparameters": Hyperparameters(lam=0.7)}, "ppo", 7, lw.PPOConfig(lam=0.7, gamma=0.9)),
        ({"algorithm": "npg"}, "npg", 100, lw.NPGConfig()),
    ]:
        configuration = Train(task=task, **flags).configuration(None, Team())
        assert (configuration.algorithm, configuration.iterations) == (algorithm, iterations)
        assert configuration.hyperparameters == hyperparameters


@pytest.mark.parametrize("training", ['lw.Training(algorithm="ppo", settings={"lamda": 0.5})',
                                      'lw.Training(algorithm="ddpg", settings={"lam": 0.5})'])  # fmt: skip
def test_training_of_a_task_that_is_not_valid_is_refused(
    training: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["train", suggesting(tmp_path, training), "--out", str(tmp_path / "run")]) == 2
    refused(capsys, "tiny.py has an invalid attribute 'training': ")
    assert not (tmp_path / "run").exists()


# interruptions


def interrupt_fourth_iteration(out: Path, times: int, monkeypatch: pytest.MonkeyPatch) -> list[int]:
    step, received = lw.Env.step, list[int]()

    def interrupting(env: lw.Env) -> None:
        step(env)
        if len(received) < times and (out / "metrics.csv").exists() and len(metrics(out)) == 3:
            received.append(signal.SIGINT)
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(lw.Env, "step", interrupting)
    return received


def test_interrupted_run_ends_after_the_iteration_and_can_be_resumed(
    trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    interrupt_fourth_iteration(out, 1, monkeypatch)
    argv = ["train", "point_mass", "--out", str(out), *TINY, *QUIET, "--iterations", "2000", "--save-every", "1000"]
    assert interrupted(argv) == 130
    shown = capsys.readouterr().out
    assert "after 4 of 2000 iterations" in shown
    assert f"lyceum-warp train --resume {out} --iterations 2000" in shown
    assert metrics(out) == metrics(trained)
    assert cli.main(["train", "--resume", str(out), "--iterations", "5", *QUIET]) == 0
    assert len(metrics(out)) == 5


@pytest.mark.parametrize("flags", [
    ["npg", "--samples", "32"], ["ppo", "--num-steps", "8", "--minibatches", "2"],
    ["sac", "--num-steps", "8", "--warmup", "72", "--batch", "16", "--replay", "100"],
], ids=lambda flags: flags[0])  # fmt: skip
def test_run_resumed_after_every_iteration_equals_an_uninterrupted_run(flags: list[str], tmp_path: Path) -> None:
    """SAC's warm-up ends within the third of five iterations. The first stop is before the first iteration."""
    options = ["--algorithm", *flags, "--nworld", "4", "--horizon", "10", "--hidden", "8", "--value-hidden", "8",
               "--mean-every", "2", "--mean-episodes", "2", *QUIET]  # fmt: skip
    assert cli.main(["train", "point_mass", "--out", str(tmp_path / "whole"), "--iterations", "5", *options]) == 0
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(ALGORITHMS[flags[0]][0], "__next__", lambda learner: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            cli.main(["train", "point_mass", "--out", str(tmp_path / "parts"), "--iterations", "5", *options])
    for iteration in range(1, 6):
        resume = ["train", "--resume", str(tmp_path / "parts"), "--iterations", str(iteration), *QUIET]
        assert cli.main(resume) == 0
    assert metrics(tmp_path / "parts") == metrics(tmp_path / "whole")
    one, other = (torch.load(tmp_path / name / "checkpoint.pt")["state"] for name in ("parts", "whole"))
    for part in ("env", "policy", "value", "generator"):
        torch.testing.assert_close(one[part], other[part], rtol=0.0, atol=0.0)


def test_verbose_prints_the_metrics_whenever_the_mean_policy_is_evaluated(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    task = str(Path(__file__).parents[1] / "metered_task.py")
    flags = ["--algorithm", "ppo", "--nworld", "4", "--num-steps", "8", "--minibatches", "2", "--hidden", "8"]
    flags += ["--value-hidden", "8", "--horizon", "6", "--mean-every", "2", "--mean-episodes", "2", "--iterations", "2"]
    assert cli.main(["train", task, "--out", str(tmp_path / "run"), "--verbose", *flags, *QUIET]) == 0
    (row,) = metrics(tmp_path / "run")[1:]
    text = capsys.readouterr().out
    assert "iteration 1 " not in text.replace("iteration    1", "")
    for name in ("forward", "effort"):
        assert re.search(rf"\b{name} +{re.escape(format(float(row[f'metrics/{name}']), '.4g'))}\b", text)


def test_second_interrupt_ends_a_run_immediately(
    trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    received = interrupt_fourth_iteration(out, 3, monkeypatch)
    argv = ["train", "point_mass", "--out", str(out), *TINY, "--no-video", "--iterations", "9", "--save-every", "2"]
    assert interrupted(argv) == 130
    monkeypatch.undo()
    shown = capsys.readouterr().out
    assert len(received) == 2 and "interrupted by SIGINT after 2 of 9 iterations" in shown
    assert f"curve:      {out / 'curve.png'}" in shown and (out / "curve.png").stat().st_size > 1000
    assert cli.main(["train", "--resume", str(out), "--iterations", "4", *QUIET]) == 0
    assert metrics(out) == metrics(trained)


def test_continue_starts_a_run_then_continues_it_then_reports_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    assert train(tmp_path / "whole", "--iterations", "4") == 0
    for total in ("2", "4", "4"):
        assert train(out, "--iterations", total, "--continue") == 0
    assert metrics(out) == metrics(tmp_path / "whole")
    assert f"the run in {out} is complete" in capsys.readouterr().out
    assert train(out, "--iterations", "9", "--continue", "--seed", "5") == 2
    refused(capsys, "has seed 0, not 5", "omit seed")


def test_continue_replaces_what_a_kill_before_the_first_save_left(tmp_path: Path) -> None:
    out = tmp_path / "run"
    assert train(out, "--iterations", "1") == 0
    for name in ("checkpoint.pt", "previous.pt", "metrics.csv"):
        (out / name).unlink(missing_ok=True)
    assert train(out, "--iterations", "1", "--continue") == 0
    assert len(metrics(out)) == 1
