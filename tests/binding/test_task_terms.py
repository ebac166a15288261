from pathlib import Path

import numpy as np
import pytest
import tiny_task
import torch
from terms_task import Terms

import lyceum_warp as lw
from lyceum_warp.testing import check_task

ENGINES = pytest.mark.parametrize("engine", ["mujoco", "warp"])


def stepped(env: lw.Env, steps: int = 12) -> list[dict[str, np.ndarray]]:
    found = []
    generator = torch.Generator().manual_seed(0)
    for _ in range(steps):
        before = {name: part.numpy() for name, part in env.state_space.split(env.get_state()).items()}
        action = torch.rand((env.nworld, env.action_space.size), generator=generator) * 2 - 1
        env.step(action)
        after = {name: part.numpy() for name, part in env.state_space.split(env.get_state()).items()}
        shown = {"reward": env.reward, "terminated": env.terminated, "truncated": env.truncated, **env.metrics}
        found.append({f"{name}0": part for name, part in before.items()} | after | {"action": action.numpy()})
        found[-1] |= {name: buffer.numpy().copy() for name, buffer in shown.items()}
    return found


@ENGINES
def test_rewards_metrics_and_ends_equal_their_formulas(engine: str) -> None:
    env = lw.make(Terms, nworld=6, engine=engine, autoreset=False, seed=1)
    ended, cut = np.zeros((2, 6), dtype=bool)
    for s in stepped(env, 40):
        wanted = {
            "near": np.exp(-np.abs(s["qpos"][:, 0] - 0.3)), "fast": 2 * 0.5 * np.abs(s["qvel"][:, 0]),
            "effort": -0.1 * (s["action"] ** 2).sum(axis=1), "change": 0.25 * 0.3 * (s["pushes"] - s["pushes0"])[:, 0],
        }  # fmt: skip
        wanted = {name: env.timestep * values for name, values in wanted.items()}
        for name, values in wanted.items():
            np.testing.assert_allclose(s[name], values, rtol=1e-4, atol=1e-6)
        np.testing.assert_allclose(s["reward"], sum(wanted.values()), rtol=1e-4, atol=1e-6)
        np.testing.assert_allclose(s["distance"], np.abs(s["qpos"][:, 0] - 0.3), atol=1e-5)
        outside, fast = np.abs(s["qpos"][:, 0]) > 0.4, np.abs(s["qvel"][:, 0]) > 3
        assert np.array_equal(s["outside"] == 1, outside) and np.array_equal(s["too_fast"] == 1, fast)
        assert np.array_equal(s["too_fast_before"] == 1, np.abs(s["qvel0"][:, 0]) > 3)
        ended |= outside | fast
        assert np.array_equal(s["terminated"], ended), "an end stays set without automatic resets"
        arrived = (np.abs(s["qpos"][:, 0] - 0.3) < 0.02) & (s["qvel"][:, 0] > 0)
        assert np.array_equal(s["arrived"] == 1, arrived)
        cut |= arrived
        assert np.array_equal(s["truncated"], cut)
    assert list(env.metrics) == [*Terms.rewards, *Terms.metrics, *Terms.terminations, *Terms.truncations]
    assert ended.any() and cut.any() and not cut.all()


@ENGINES
def test_weights_are_set_like_parameters_and_may_differ_between_worlds(engine: str) -> None:
    env, other = (lw.make(Terms, nworld=2, engine=engine, seed=1, **words) for words in ({}, {"near": 2.0, "fast": 0}))
    action = torch.ones((2, env.action_space.size))
    start = env.get_state()
    env.step(action)
    other.set_state(start)
    other.step(action)
    assert torch.equal(other.metrics["near"], 2 * env.metrics["near"]) and not other.metrics["fast"].any()
    after = env.get_state()
    plain = env.get_reward(start, action, after)
    env.set_params(near=[1.0, 4.0])
    different = env.get_reward(start, action, after) - plain
    torch.testing.assert_close(different, torch.tensor([0.0, 3.0]) * env.metrics["near"], atol=1e-6, rtol=0)
    assert env.replicate().task.params["near"].tolist() == [1.0, 4.0]
    env.set_params(near=1)
    assert torch.equal(env.get_reward(start, action, after), plain)
    with pytest.raises(ValueError, match="there is no parameter 'neer': did you mean near"):
        env.set_params(neer=2.0)


TASK = "class Tiny(lw.Task):"


def term(function: str, *lines: str, before: str = "") -> list[tuple[str, str]]:
    body = "\n".join(f"    {line}" for line in lines or ('rewards = {"upright": 1.0}',))
    return [(TASK, f"{before}@wp.func\n{function}\n\n{TASK}\n{body}")]


UPRIGHT = "def upright(s: World) -> float:\n    return s.qpos[1]"

MISTAKES: dict[str, tuple[list[tuple[str, str]], str]] = {
    "a misspelt term": (
        term(UPRIGHT, 'rewards = {"uprihgt": 1.0}'), "rewards has 'uprihgt', but there is no such",
    ),
    "a misspelt argument": (
        term("def upright(qops: Row[float]) -> float:\n    return qops[1]"),
        r"upright \(tiny\.py, line \d+\) takes qops, which is not a function of the task, a "
        r"parameter or a field of World: did you mean qpos\?",
    ),
    "an argument of another type": (
        term("def upright(qpos: float) -> float:\n    return qpos"),
        r"upright \(.*\) takes qpos as float, but s1\.qpos is array\(ndim=1, dtype=float32\)",
    ),
    "a result of another type": (
        term("def upright(s: World) -> bool:\n    return s.qpos[1] > 1.0"),
        r"upright \(.*\) returns bool, but must return float",
    ),
    "no type of the result": (
        term("def upright(s: World):\n    return s.qpos[1]"), r"upright \(.*\) has no type for its",
    ),
    "a termination that asks for the action": (
        term("def fell(action: Row[float]) -> bool:\n    return action[0] > 1.0", 'terminations = ("fell",)'),
        r"fell \(.*\) takes action, but the end of an episode depends only on the state",
    ),
    "terms that need each other": (
        term("def a(b: float) -> float:\n    return b", 'rewards = {"a": 1.0}',
             before="@wp.func\ndef b(a: float) -> float:\n    return a\n\n"),
        "terms depend on each other in a cycle: a needs b needs a",
    ),
    "a term that writes": (
        term("def upright(s: World) -> float:\n    s.qpos[0] = 1.0\n    return 1.0"),
        r"upright writes s\.qpos \(tiny\.py, line \d+\): upright may write nothing",
    ),
    "rewards beside reward": (
        term(f"def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:\n    return 0.0\n\n"
             f"@wp.func\n{UPRIGHT}"),
        "there are rewards and a function reward: remove one of them",
    ),
    "names without weights": (
        term(UPRIGHT, 'rewards = ("upright",)'), r"rewards must be a dict of names and weights",
    ),
    "a weight that is not a number": (
        term(UPRIGHT, 'rewards = {"upright": "1"}'),
        "the weight of 'upright' must be a number, not '1'",
    ),
    "a term with the name of a parameter": (
        [*term(UPRIGHT), ("    dt: float", "    dt: float\n    upright: float = 1.0")],
        "'upright' is the name of a term and of a parameter",
    ),
    "a term with the name of an option": (
        term("def horizon(s: World) -> float:\n    return 1.0", 'rewards = {"horizon": 1.0}'),
        "the parameter 'horizon' has the name of an option of make",
    ),
    "no seconds in a step": (
        [*term(UPRIGHT), ("    dt: float", "    gain: float = 1.0")],
        "rewards are multiplied by dt: add dt: float to Params",
    ),
    "a metric without a function": (
        [(TASK, f'{TASK}\n    metrics = ("height",)')],
        "metrics has 'height', but there is no such function: .*, or write measure",
    ),
    "a metric that is a term": (
        term(UPRIGHT, 'rewards = {"upright": 1.0}', 'metrics = ("upright",)'),
        "the metric 'upright' is named twice",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("changes", "message"), MISTAKES.values(), ids=MISTAKES)
def test_invalid_term_raises_a_one_line_error_that_names_it(
    changes: list[tuple[str, str]], message: str, tmp_path: Path
) -> None:
    tiny_task.check_mistake(tmp_path, changes, message)


@ENGINES
def test_task_with_terms_passes_check_task(engine: str) -> None:
    check_task(Terms, engine=engine, steps=40)


def test_term_that_reads_out_of_range_raises_an_error(tmp_path: Path) -> None:
    source = tiny_task.changed(*term("def upright(qpos: Row[float]) -> float:\n    return qpos[60]"))
    with pytest.raises(ValueError, match="reward reads out of range"):
        lw.make(tiny_task.write(tmp_path, source))
