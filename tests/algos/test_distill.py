import copy
import math
import shutil
from pathlib import Path
from typing import Any

import pytest
import tiny_task
import torch
from conftest import SharedEnv, TaskFile
from hidden_task import Hidden
from metered_task import Metered
from training_runs import QUIET, metrics, refused

import lyceum_warp as lw
from lyceum_warp import cli
from lyceum_warp.controllers import policy_episodes

SMALL: dict[str, Any] = {"hidden": (8,), "num_steps": 12, "mean_every": 2, "mean_episodes": 2}
FAST: dict[str, Any] = {"learning_rate": 1e-2, "gradient_length": 6}
TINY = ["--algorithm", "distill", "--nworld", "4", "--num-steps", "12", "--hidden", "8", "--mean-every", "2",
        "--mean-episodes", "2", *QUIET]  # fmt: skip


def braking() -> lw.GaussianPolicy:
    """Make a teacher of ``Metered`` that needs the hidden velocity: action = -0.5 v."""
    teacher = lw.GaussianPolicy(2, 1, (), activation="tanh")
    with torch.no_grad():
        teacher.network[0].weight.copy_(torch.tensor([[0.0, -0.5]]))
        teacher.network[0].bias.zero_()
    return teacher


def loss(env: lw.Env, **changes: Any) -> float:
    config = lw.DistillConfig(**SMALL | {"teacher_group": "critic", "mean_every": 0, **FAST} | changes)
    learner = lw.Distill(env, config=config, teacher=braking())
    return sum([next(learner).loss for _ in range(50)][30:]) / 20


def test_student_with_memory_learns_what_it_cannot_see(shared_env: SharedEnv) -> None:
    env = shared_env(Metered, nworld=32, far=1e3)
    blind, remembering = loss(env), loss(env, recurrent=16)
    assert remembering < 0.5 * blind, (remembering, blind)


def test_student_without_memory_imitates_what_it_sees(shared_env: SharedEnv) -> None:
    env, teacher = shared_env("point_mass", nworld=16, horizon=30), lw.load(lw.pretrained_run("hopper"))
    with pytest.raises(ValueError, match="the teacher is made for 11 observations and 3 actions"):
        lw.Distill(env, teacher=teacher)
    torch.manual_seed(0)
    learner = lw.Distill(env, config=lw.DistillConfig(**SMALL, **FAST), teacher=lw.GaussianPolicy(6, 2, (4,)))
    rows = [next(learner) for _ in range(30)]
    assert rows[-1].loss < 0.02 * rows[0].loss and rows[1].mean_return is not None
    assert rows[-1].samples == 30 * 12 * 16 and rows[-1].length_mean == 30.0
    config = lw.PPOConfig(value_hidden=(8,), mean_every=0, value_only=1)
    ppo = lw.PPO(env, copy.deepcopy(learner.policy), config=config)  # PPO goes on from the student
    bias = ppo.value.network[-1].bias.clone()
    assert next(ppo).std_mean == pytest.approx(math.exp(-2.3)) and not torch.equal(ppo.value.network[-1].bias, bias)
    pairs = list(zip(ppo.policy.parameters(), learner.policy.parameters(), strict=True))
    assert all(torch.equal(p, q) for p, q in pairs)
    next(ppo)
    assert not any(torch.equal(p, q) for p, q in pairs)


def test_student_imitates_saved_episodes(shared_env: SharedEnv) -> None:
    env, teacher = shared_env("point_mass", nworld=16, horizon=30), lw.GaussianPolicy(6, 2, (4,))
    episodes = list(policy_episodes(env.replicate(autoreset=False), teacher, 20, seed=1))
    given = lw.Demonstrations(episodes)
    assert given.step.tolist() == 20 * list(range(30)) and torch.equal(given.action[30:60], episodes[1].actions)
    learner = lw.Distill(env, config=lw.DistillConfig(**SMALL, **FAST), teacher=given)
    before = env.get_state()
    rows = [next(learner) for _ in range(30)]
    assert torch.equal(env.get_state(), before)
    assert rows[-1].loss < 0.02 * rows[0].loss and rows[-1].mean_return is not None and rows[-1].return_mean is None
    rollout = learner.rollout
    assert torch.equal(rollout.step[1:], torch.where(rollout.step[:-1] == 29, 0.0, rollout.step[:-1] + 1.0))
    with pytest.raises(ValueError, match="there is no episode"):
        lw.Demonstrations([])


@pytest.mark.parametrize("demonstrated", [False, True])
def test_distill_resumes_bit_for_bit(demonstrated: bool, shared_env: SharedEnv) -> None:
    env = shared_env(Hidden, nworld=4, horizon=10)
    teacher: Any = lw.GaussianPolicy(4, 1, (4,), recurrent=3)  # a teacher with memory
    if demonstrated:
        student = lw.GaussianPolicy(2, 1, (4,))
        teacher = lw.Demonstrations(policy_episodes(env.replicate(autoreset=False), student, 4, seed=1))
    config = lw.DistillConfig(**SMALL, recurrent=6)
    one, other = (lw.Distill(worlds, config=config, teacher=teacher, seed=1) for worlds in (env, env.replicate()))
    next(other)
    for _ in range(2):
        next(one)
    other.load_state_dict(copy.deepcopy(one.state_dict()))
    for _ in range(2):
        first, second = next(one), next(other)
        assert (first.loss, first.reward_mean, first.mean_return) == (
            second.loss,
            second.reward_mean,
            second.mean_return,
        )
    assert all(torch.equal(p, q) for p, q in zip(one.policy.parameters(), other.policy.parameters(), strict=True))


def test_run_of_a_student_resumes_without_its_teachers_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    teacher = tmp_path / "teacher"
    shutil.copytree(lw.pretrained_run("hopper"), teacher)
    for run, iterations in (("whole", "4"), ("halved", "2")):
        words = [
            "train",
            "hopper",
            "--horizon",
            "30",
            "--teacher",
            str(teacher / "policy.pt"),
            "--recurrent",
            "4",
            *TINY,
        ]
        assert cli.main([*words, "--iterations", iterations, "--out", str(tmp_path / run)]) == 0
    shutil.rmtree(teacher)
    assert cli.main(["train", "--resume", str(tmp_path / "halved"), "--iterations", "4", *QUIET]) == 0
    assert metrics(tmp_path / "halved") == metrics(tmp_path / "whole")
    files = [tmp_path / run / "policy.pt" for run in ("whole", "halved")]
    one, other = (lw.load(file).state_dict() for file in files)
    assert all(torch.equal(one[name], other[name]) for name in one)
    out = str(tmp_path / "further")
    words = ["--from", str(tmp_path / "whole"), "--algorithm", "ppo", "--iterations", "1", "--value-hidden", "8"]
    assert cli.main(["train", *words, "--out", out, "--mean-every", "0", *QUIET]) == 0
    further = lw.load(out)
    assert further.state_size == 4 and lw.load_value(out).state_size == 4
    # at first, only the value function learns, if it is new
    student = dict(lw.load(tmp_path / "whole").named_parameters())
    assert all(torch.equal(part, student[name]) for name, part in further.named_parameters())
    words = ["--from", out, "--iterations", "1", "--out", str(tmp_path / "third"), "--mean-every", "0"]
    assert cli.main(["train", *words, *QUIET]) == 0
    assert not torch.equal(lw.load(tmp_path / "third").log_std, further.log_std)
    capsys.readouterr()
    assert cli.main(["train", "--resume", out, "--teacher", "hopper"]) == 2
    refused(capsys, "--teacher has no effect with --resume")


def test_run_imitates_the_episodes_of_a_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    env = lw.make("point_mass", nworld=2, horizon=8, autoreset=False)
    for number, episode in enumerate(policy_episodes(env, lw.GaussianPolicy(6, 2), 2)):
        episode.save(tmp_path / "episodes" / f"{number}.npz")
    words = ["train", "point_mass", "--horizon", "8", *TINY, "--demonstrations", str(tmp_path / "episodes")]
    assert cli.main([*words, "--iterations", "2", "--out", str(tmp_path / "run")]) == 0
    # without an evaluation, the curve shows the loss
    assert cli.main([*words, "--mean-every", "0", "--iterations", "1", "--out", str(tmp_path / "short"), "--plot"]) == 0
    assert (tmp_path / "short" / "curve.png").exists()
    shutil.rmtree(tmp_path / "episodes")
    assert cli.main(["train", "--resume", str(tmp_path / "run"), "--iterations", "3", *QUIET]) == 0
    assert len(metrics(tmp_path / "run")) == 3 and "loss" in capsys.readouterr().out


@pytest.mark.parametrize(("words", "message"), [
    (["point_mass", "--algorithm", "distill"], "give --teacher RUN, or --demonstrations FILE"),
    (["hopper", "--teacher", "hopper"], "need --algorithm distill"),
    (["hopper", "--algorithm", "distill", "--teacher", "hopper", "--demonstrations", "x"], "omit one of them"),
    (["hopper", "--algorithm", "distill", "--teacher", "nowhere"], "there is no run in nowhere"),
    (["hopper", "--algorithm", "distill", "--teacher", "hopper", "--teacher-group", "own"], "no group 'own'"),
])  # fmt: skip
def test_unsuitable_teacher_is_refused(
    words: list[str], message: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert cli.main(["train", *words, "--nworld", "2", "--out", str(tmp_path / "run")]) == 2
    refused(capsys, message)
    assert not (tmp_path / "run").exists()


def test_teacher_with_other_observations_is_refused(
    task_file: TaskFile, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    file, other = (
        task_file(f"{name}.py", tiny_task.changed(('obs = {"x": 1}', f'obs = {{"{name}": 1}}'))) for name in "xy"
    )
    teacher = str(tmp_path / "teacher")
    words = ["--nworld", "2", "--horizon", "4", "--samples", "8", "--hidden", "4", "--mean-every", "0", *QUIET]
    assert cli.main(["train", str(file), *words, "--iterations", "1", "--out", teacher]) == 0
    assert cli.main(["train", str(other), *TINY, "--teacher", teacher, "--out", str(tmp_path / "run")]) == 2
    refused(capsys, "the teacher's observations are x, but the group 'policy' of the task", "has y")


def test_invalid_distill_arguments_raise_an_error(shared_env: SharedEnv) -> None:
    env = shared_env("point_mass", nworld=2)
    with pytest.raises(ValueError, match="gradient_length=5 must divide num_steps, which is 24"):
        lw.DistillConfig(gradient_length=5)
    with pytest.raises(
        ValueError, match="teacher must be a policy with act, nobs and nact, or lw.Demonstrations, not 3"
    ):
        lw.Distill(env, teacher=3)  # type: ignore[arg-type]
    with pytest.raises(FloatingPointError, match="iteration 1 is not finite: make learning_rate"):
        next(lw.Distill(env, config=lw.DistillConfig(learning_rate=1e38), teacher=lw.GaussianPolicy(6, 2)))
