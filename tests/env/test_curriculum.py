from pathlib import Path

import pytest
import torch
import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row, cli
from lyceum_warp.algos import evaluation_seed
from lyceum_warp.controllers import policy_episodes
from lyceum_warp.training import Run


@wp.struct
class Shared:
    bonus: Row[float] = lw.part()


@wp.struct
class Sums:
    steps: Row[float] = lw.part()


@wp.struct
class World:
    qpos: Row[float]
    qvel: Row[float]
    shared: Shared
    level: Row[float] = lw.lasting_memory()
    drawn: Row[float] = lw.lasting_memory()


@wp.struct
class Params:
    dt: float


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    obs[0] = s.qpos[0]


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    return s1.level[0] + s1.shared.bonus[0]


@wp.func
def height(level: Row[float]) -> float:
    return level[0]


@wp.func
def startup(s: World, p: Params, rng: Row[wp.uint32]):
    s.drawn[0] = lw.uniform(rng, 0.0, 1.0)


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    s.qpos[0] = lw.uniform(rng, -0.1, 0.1)


@wp.func
def advance(s0: World, action: Row[float], s1: World, p: Params, rng: Row[wp.uint32]):
    s1.level[0] = s0.level[0] + 0.1


@wp.func
def tally(s0: World, action: Row[float], s1: World, p: Params, ended: bool, sums: Sums):
    sums.steps[0] = 1.0


@wp.func
def share(shared: Shared, sums: Sums, p: Params):
    shared.bonus[0] += 100.0


class Ladder(lw.Task):
    """The reward is the level: a cart climbs one level an episode. All worlds share the bonus."""

    model, obs = "inverted_pendulum.xml", {"place": 1}
    frame_skip, horizon = 1, 10
    metrics = ("height",)


CONFIG = lw.PPOConfig(num_steps=10, minibatches=1, epochs=1, hidden=(8,), value_hidden=(8,), mean_every=1,
                      mean_episodes=4)  # fmt: skip
# an episode begins at level l with ten steps, whose rewards are l + 0.1, ..., l + 1.0
FIRST_EPISODE = 5.5


def still(obs: torch.Tensor) -> torch.Tensor:
    return torch.zeros(len(obs), 1)


def make(nworld: int, **options: object) -> lw.Env:
    return lw.make(Ladder, nworld=nworld, **options)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Train for three iterations, in which every world plays one episode."""
    folder = tmp_path_factory.mktemp("runs") / "ladder"
    lw.train(lw.PPO(make(4), config=CONFIG), folder, 3, keep_every=1)
    return folder


def test_episodes_begin_at_the_same_level_however_many_worlds_play_them() -> None:
    few, many = (lw.evaluate(make(nworld), still, 8, seed=1) for nworld in (2, 8))
    torch.testing.assert_close(many.returns, torch.full((8,), FIRST_EPISODE))
    assert torch.equal(few.returns, many.returns)
    assert not few.curriculum.lasting["level"].any()
    env = make(2)
    lw.evaluate(env, still, 2, seed=1)
    later = lw.evaluate(env, still, 4)  # without a seed, levels go on
    torch.testing.assert_close(later.returns, torch.full((4,), 10.0 + FIRST_EPISODE))


def test_episodes_begin_at_a_given_curriculum_and_report_it() -> None:
    levels = torch.tensor([[3.0], [7.0]])
    curriculum = lw.Curriculum(shared={"bonus": torch.tensor([100.0])}, lasting={"level": levels})
    env = make(4)
    episodes = lw.evaluate(env, still, 8, seed=1, curriculum=curriculum)
    assert episodes.curriculum.lasting["level"].flatten().tolist() == 4 * [3.0] + 4 * [7.0]
    expected = 10.0 * (100.0 + levels.repeat_interleave(4)) + FIRST_EPISODE
    torch.testing.assert_close(episodes.returns, expected)
    assert episodes.curriculum.text == "bonus 100, level 5 (3 to 7)"
    torch.testing.assert_close(episodes.select(slice(4, 6)).step_metrics["height"], torch.full((2,), 7.55))


def test_curriculum_of_another_version_of_the_task_is_refused() -> None:
    curriculum = lw.Curriculum(shared={"bonus": torch.zeros(3)})
    with pytest.raises(ValueError, match=r"no memory 'bonus' of size 3; it has: bonus \(1\)"):
        list(policy_episodes(make(2, autoreset=False), still, 2, curriculum=curriculum))


def test_saved_episodes_equal_the_evaluated_ones() -> None:
    curriculum = lw.Curriculum(lasting={"level": torch.tensor([[2.0], [4.0]])})
    episodes = lw.evaluate(make(2), still, 4, seed=3, curriculum=curriculum)
    saved = policy_episodes(make(2, autoreset=False), still, 4, seed=evaluation_seed(3), curriculum=curriculum)
    assert [episode.episode_return for episode in saved] == pytest.approx(episodes.returns.tolist())


def test_memory_that_startup_alone_writes_is_drawn_for_each_evaluation(run: Path) -> None:
    assert list(lw.load_curriculum(run).lasting) == ["level"]
    env = make(4)
    lw.evaluate(env, still, 4, seed=1, curriculum=lw.load_curriculum(run))
    assert len(env.lasting["drawn"].unique()) == 4


def test_run_is_evaluated_at_the_curriculum_of_the_saved_policy(run: Path) -> None:
    for which, episodes in (("1", 1), ("2", 2), ("last", 3)):
        curriculum = lw.load_curriculum(run, which=which)
        assert curriculum.shared["bonus"].item() == 100.0 * episodes
        torch.testing.assert_close(curriculum.lasting["level"], torch.full((4, 1), float(episodes)))


def test_mean_policy_is_evaluated_at_the_level_of_training(run: Path) -> None:
    returns = [row["mean_return"] for row in Run.open(run).rows()]
    assert returns == pytest.approx([10 * (100.0 * k + k) + FIRST_EPISODE for k in (1, 2, 3)])


def test_verdict_is_judged_at_the_level_of_the_environment() -> None:
    env = make(4)
    for _ in range(30):
        env.step()
    verdict = lw.transfer(env, still, 4, warp=False)
    assert verdict.memory == "bonus 0, level 3" and verdict.line.endswith("begun at bonus 0, level 3")


@pytest.mark.parametrize(
    ("flags", "memory"),
    [
        ([], "memory at the start (the run's): bonus 300, level 3"),
        (["--fresh-memory"], "memory at the start (new): bonus 0, level 0"),
        (["--memory", "level=5"], "memory at the start (as given): bonus 0, level 5"),
        (["--memory", "bonus=7"], "memory at the start (as given): bonus 7, level 0"),
    ],
)
def test_command_prints_the_level_of_an_evaluation(
    run: Path, flags: list[str], memory: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["eval", str(run), "--which", "last", "--episodes", "4", *flags]) == 0
    assert memory in capsys.readouterr().out


def test_command_evaluates_several_levels(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["eval", str(run), "--which", "last", "--episodes", "2", "--memory", "level=1,4"]) == 0
    lines = capsys.readouterr().out.splitlines()
    (low,), (high,) = ([line.split() for line in lines if f"level {level}" in line] for level in (1, 4))
    assert low[4] == "15.5" and high[4] == "45.5"


@pytest.mark.parametrize("memory", ["height=1", "level=1,x", "shared=1"])
def test_unknown_memory_is_refused(run: Path, memory: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["eval", str(run), "--episodes", "2", "--memory", memory]) == 2
    assert memory.partition("=")[0] in capsys.readouterr().err
