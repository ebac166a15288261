import shutil
from pathlib import Path

import pytest
import torch
from conftest import SharedEnv
from training_runs import CONFIG, QUIET, algorithm, mean_action, metrics, refused, six_iterations, train

import lyceum_warp as lw
from lyceum_warp import cli
from lyceum_warp.algos import evaluation_seed
from lyceum_warp.training import Run, learning_curve


@pytest.fixture
def env(shared_env: SharedEnv) -> lw.Env:
    """Tests that compare numbers must not use this environment, because other tests advance its random streams."""
    return shared_env("point_mass", nworld=2)


@pytest.fixture(scope="module")
def six(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return six_iterations(tmp_path_factory.mktemp("runs") / "six")


def test_training_in_python_and_on_the_command_line_gives_equal_metrics(six: Path, tmp_path: Path) -> None:
    out = tmp_path / "command"
    assert train(out, "--iterations", "6", "--keep-every", "2") == 0
    assert metrics(out) == metrics(six)
    one, other = ({path.name for path in folder.rglob("*")} for folder in (out, six))
    assert one == other
    configs = [Run.open(folder).config for folder in (out, six)]
    settings = {"target_return": None, "tensorboard": False, "video_every": 0, "gate_every": 0}
    assert configs[0] == configs[1] | settings | {"threads": 1}


def test_run_started_in_python_is_evaluated_and_resumed_on_the_command_line(
    six: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = Path(shutil.copytree(six, tmp_path / "run"))
    run = Run.open(folder)
    run.amend(versions=run.config["versions"] | {"torch": "2.0"})
    assert cli.main(["eval", str(folder), "--episodes", "2", "--which", "best"]) == 0
    capsys.readouterr()
    assert cli.main(["train", "--resume", str(folder), "--iterations", "7", *QUIET]) == 0
    assert metrics(folder)[:6] == metrics(six)
    refused(capsys, f"numbers may differ from an uninterrupted run's: torch 2.0 then, {torch.__version__} now")
    assert Run.open(folder).config["resumed"] == [{"torch": torch.__version__}]


def test_resumed_run_keeps_the_limit_of_its_policy(env: lw.Env, tmp_path: Path) -> None:
    wide = lw.GaussianPolicy(6, 2, (8,), normalize=True, limit=1e6)
    run = lw.train(algorithm(env, policy=wide), tmp_path / "run", 1)
    assert cli.main(["train", "--resume", str(run.folder), "--iterations", "2", *QUIET]) == 0
    assert lw.load(run).shape["limit"] == 1e6


def test_run_of_a_partly_trained_learner_is_complete(six: Path, tmp_path: Path) -> None:
    npg, folder = algorithm(lw.make("point_mass", nworld=2)), tmp_path / "run"
    for _ in range(3):
        next(npg)
    assert lw.train(npg, tmp_path / "three", 3).read()["iteration"] == 3
    assert lw.load(tmp_path / "three").nact == 2
    begun = []

    def callback(iteration: lw.Iteration) -> bool:
        begun.append(Run.open(folder).read()["iteration"])
        return iteration.iteration == 5

    lw.train(npg, folder, 9, callbacks=[callback], save_every=100)
    assert begun == [3, 3]
    previous = folder / "previous.pt"  # simulate the state after kill -9 in iteration 6
    previous.replace(folder / "checkpoint.pt")
    lw.train(algorithm(lw.make("point_mass", nworld=2)), lw.Run.open(folder), 6)
    assert metrics(folder) == metrics(six)[3:]


def test_invalid_train_arguments_make_no_folder(env: lw.Env, tmp_path: Path) -> None:
    npg = algorithm(env)
    for options, text in [
        ({"iterations": 0}, "iterations .* 0"),
        ({"keep_every": -1}, "keep_every .* -1"),
        ({"save_every": 1.5}, "save_every .* 1.5"),
        ({"entries": "note"}, "entries .* 'note'"),
        ({"callbacks": print}, "callbacks .* print"),
        ({"callbacks": [3]}, "callbacks .* 3"),
    ]:
        with pytest.raises(ValueError, match=text):
            lw.train(npg, tmp_path / "run", **options)  # type: ignore[arg-type]
    assert not (tmp_path / "run").exists()


def test_policies_are_loaded_by_name_and_number(six: Path) -> None:
    returns = [float(row["mean_return"]) for row in metrics(six) if row["mean_return"]]
    best = 2 * (returns.index(max(returns)) + 1)
    actions = {which: mean_action(lw.load(six, which=which)) for which in ("last", "best", 2, 4, "6")}
    assert torch.equal(actions["best"], actions[str(best) if best == 6 else best])
    assert torch.equal(actions["last"], actions["6"])
    assert not torch.equal(actions[2], actions[4])
    assert lw.load_value(six, which="best").discount == CONFIG.gamma
    with pytest.raises(FileNotFoundError, match=r"has no policy 3: it has 'last', 'best', 2, 4, 6"):
        lw.load(six, which=3)
    with pytest.raises(
        ValueError, match="no policy is named 'worst': pass 'last', 'best' or the number of an iteration"
    ):
        lw.load(six, which="worst")


def test_best_policy_has_the_highest_sampled_return_if_evaluations_are_off(tmp_path: Path) -> None:
    config = lw.NPGConfig(samples=512, hidden=(8,), value_hidden=(8,), mean_every=0)
    lw.train(lw.NPG(lw.make("point_mass", nworld=2), config=config), tmp_path / "run", 4, keep_every=1)
    returns = [float(row["return_mean"]) for row in metrics(tmp_path / "run")]
    iteration, score = Run.open(tmp_path / "run").best_score() or (-1, 0.0)
    assert score == max(returns) and iteration == returns.index(score)
    if iteration > 0:
        best, numbered = (mean_action(lw.load(tmp_path / "run", which=which)) for which in ("best", iteration))
        assert torch.equal(best, numbered)


def test_run_resumes_identically_from_the_last_complete_state(six: Path, tmp_path: Path) -> None:
    """Simulate kill -9 in iteration 5. The last save is from iteration 3, and the last row is from iteration 4."""
    folder = tmp_path / "run"
    states = {}

    def callback(iteration: lw.Iteration) -> None:
        states[iteration.iteration] = {path: path.read_bytes() for path in folder.rglob("*.*")}

    npg = algorithm(lw.make("point_mass", nworld=2))
    lw.train(npg, folder, 6, save_every=3, keep_every=2, callbacks=[callback])
    for path in folder.rglob("*.*"):
        path.unlink()
    for path, content in states[4].items():
        path.write_bytes(content)
    run = Run.open(folder)
    assert run.read()["iteration"] == 3 and len(run.rows()) == 4
    assert torch.equal(mean_action(lw.load(folder, which=4)), mean_action(lw.load(six, which=4)))
    assert cli.main(["train", "--resume", str(folder), "--iterations", "6", *QUIET]) == 0
    assert metrics(folder) == metrics(six)
    for which in ("last", "best"):
        assert torch.equal(mean_action(lw.load(folder, which=which)), mean_action(lw.load(six, which=which)))


def test_training_from_another_run_starts_with_its_policy(
    six: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    arguments = ["train", "--from", str(six), "--which", "4", "--param", "success_distance=0.5", "--iterations", "1"]
    assert cli.main([*arguments, "--out", str(out), "--keep-every", "1", *QUIET]) == 0
    config = Run.open(out).config
    assert config["from"] == {"run": str(six), "which": "4", "iteration": 4}
    assert (config["task"], config["params"], config["nworld"]) == ("point_mass", {"success_distance": 0.5}, 2)
    assert config["npg"] == Run.open(six).config["npg"]
    state = Run.open(out).read()["state"]
    assert state["iteration"] == 1
    moved = mean_action(lw.load(out)) - mean_action(lw.load(six, which=4))
    assert 0 < moved.abs().max() < 1.0
    assert cli.main(["train", "--resume", str(out), "--iterations", "2", *QUIET]) == 0
    capsys.readouterr()
    for options, words in [
        (["hopper"], ["takes 6 observations", "'hopper' has 11"]),
        (["--hidden", "64", "64"], ["have hidden (8,), not (64, 64)", "omit --hidden"]),
        (["--value-group", "critic"], ["have value_group policy, not critic", "omit --value-group"]),
        (["--algorithm", "sac"], [f"{six} was trained by npg", "omit --algorithm sac"]),
        (["--which", "5"], ["has no policy '5': it has 'last', 'best', 2, 4, 6"]),
        (["--resume", str(six)], ["--from has no effect with --resume"]),
    ]:
        assert cli.main(["train", *options, "--from", str(six), "--out", str(tmp_path / "no")]) == 2
        refused(capsys, *words)
    assert not (tmp_path / "no").exists()


def test_flags_with_default_values_override_the_settings_of_the_source_run(six: Path, tmp_path: Path) -> None:
    old, out = Path(shutil.copytree(six, tmp_path / "old")), tmp_path / "out"
    run = Run.open(old)
    npg = run.config["npg"] | {"gamma": 0.9, "whiten": False}
    run.amend(npg=npg, seed=3, keep_every=2, options={"horizon": 32}, physics={"deterministic": True})
    command = ["train", "--from", str(old), "--iterations", "1", *QUIET]
    given = ["--gamma", "0.995", "--whiten", "--seed", "0", "--keep-every", "0", "--no-deterministic"]
    assert cli.main([*command, "--out", str(out), *given]) == 0
    config = Run.open(out).config
    assert config["npg"] == npg | {"gamma": 0.995, "whiten": True}
    assert (config["seed"], config["keep_every"], config["options"]) == (0, 0, {"horizon": 32})
    assert config["physics"] == {}


def test_evaluation_and_training_with_equal_seeds_have_different_initial_states(env: lw.Env) -> None:
    env.rand_reset(1)
    trained_on = env.obs.clone()
    env.rand_reset(evaluation_seed(1))
    assert not torch.isclose(env.obs, trained_on).all(1).any()


def test_learning_curve_without_iterations_raises_an_error(tmp_path: Path) -> None:
    run = Run.create(tmp_path, {"task": "point_mass", "seed": 3})
    run.append({"iteration": 1})
    run.cut(0)
    with pytest.raises(ValueError, match="has no complete iteration to plot: continue its training"):
        learning_curve(run)
