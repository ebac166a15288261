from pathlib import Path
from typing import Any

import pytest
import tiny_task
import torch
import warp as wp
from rail_task import rail

import lyceum_warp as lw
from lyceum_warp import Row


@wp.struct
class World:
    qpos: Row[float]
    level: Row[float] = lw.lasting_memory()
    marks: Row[float] = lw.memory("places")
    goal: Row[wp.vec3] = lw.memory()
    turn: Row[lw.quat] = lw.memory(2)


@wp.struct
class Params:
    dt: float
    places: wp.array[float] = [1.0, 2.0, 3.0]


@wp.struct
class Policy:
    marks: Row[float] = lw.part("places")
    goal: Row[wp.vec3] = lw.part()


@wp.struct
class Critic(Policy):
    turn: Row[lw.quat] = lw.part(2)
    level: Row[float] = lw.part()


@wp.func
def observe_policy(s: World, obs: Any):
    for i in range(s.marks.shape[0]):
        obs.marks[i] = s.marks[i]
    obs.goal[0] = s.goal[0]


@wp.func
def observe(s: World, p: Params, obs: Policy):
    observe_policy(s, obs)


@wp.func
def observe_critic(s: World, p: Params, obs: Critic):
    observe_policy(s, obs)
    for i in range(2):
        obs.turn[i] = s.turn[i]
    obs.level[0] = s.level[0]


@wp.func
def initialize(s: World, p: Params):
    for i in range(p.places.shape[0]):
        s.marks[i] = p.places[i]
    s.goal[0] = wp.vec3(4.0, 5.0, 6.0)
    s.turn[-1] = lw.quat(0.0, 1.0, 0.0, 0.0)


@wp.func
def advance(s0: World, action: Row[float], s1: World, p: Params, rng: Row[wp.uint32]):
    s1.goal[0] = 2.0 * s0.goal[0]
    s1.level[0] = s0.level[0] + 1.0


class Marked(lw.Task):
    model = staticmethod(rail)


@pytest.mark.parametrize("engine", ["mujoco", "warp"])
def test_states_and_observations_contain_all_parts_in_order(engine: str) -> None:
    env = lw.make(Marked, nworld=2, engine=engine)
    env.reset()
    sizes = {name: part.stop - part.start for name, part in env.state_space.parts.items()}
    own = {"marks": 3, "goal": 3, "turn": 8, "level": 1}
    assert {name: sizes[name] for name in own} == own
    assert list(sizes)[-4:] == list(own), "the order of a state: memory, then lasting memory"
    assert {name: list(space.parts) for name, space in env.obs_spaces.items()} == {
        "policy": ["marks", "goal"], "critic": ["marks", "goal", "turn", "level"],
    }  # fmt: skip
    turn = [0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0]
    assert env.obs.tolist() == 2 * [[1.0, 2.0, 3.0, 4.0, 5.0, 6.0]]
    assert env.obs_groups["critic"].tolist() == 2 * [[1.0, 2.0, 3.0, 4.0, 5.0, 6.0, *turn, 0.0]]
    env.step()
    env.reset(torch.tensor([True, False]))
    assert env.obs_groups["critic"][:, 3].tolist() == [4.0, 8.0] and env.obs_groups["critic"][:, -1].tolist() == [1, 1]
    state = env.get_state()
    parts = env.state_space.split(state)
    parts["goal"][1, 2] = 7.0
    env.set_state(state)
    assert env.obs[:, 5].tolist() == [6.0, 7.0]


STRUCT = (
    'class Tiny(lw.Task):\n    model = "hopper.xml"\n    obs = {"x": 1}',
    'class Tiny(lw.Task):\n    model = "hopper.xml"',
)
OBSERVE = "def observe(s: World, p: Params, obs: Row[float]):\n    obs[0] = s.qpos[0]"


def struct_of(text: str, body: str = "obs.x[0] = s.qpos[0]") -> str:
    return (
        f"@wp.struct\nclass Policy:\n    {text}\n\n@wp.func\ndef observe(s: World, p: Params, obs: Policy):\n    {body}"
    )


PART = "x: Row[float] = lw.part()"

MISTAKES = {
    "a part without a size": (
        [STRUCT, (f"@wp.func\n{OBSERVE}", struct_of("x: Row[float]"))],
        r"Policy\.x has no size: for three numbers, write x: Row\[float\] = lw\.part\(3\)",
    ),
    "a part that is a number": (
        [STRUCT, (f"@wp.func\n{OBSERVE}", struct_of("x: float = lw.part()"))],
        r"Policy\.x has a size, so it must be a row of floats .*: declare it as x: Row\[float\]",
    ),
    "a part that is assigned as a whole": (
        [STRUCT, (f"@wp.func\n{OBSERVE}", struct_of(PART, "obs.x = s.qpos"))],
        r"observe writes obs\.x \(tiny\.py, line \d+\): write its elements, as obs\.x\[0\] = ",
    ),
    "a struct beside obs": (
        [(f"@wp.func\n{OBSERVE}", struct_of(PART))],
        r"observe must be written as observe\(.*\), .*; to write the struct Policy, remove obs from",
    ),
    "neither a struct nor obs": ([STRUCT], "there is no obs: .* or let observe take a struct of parts"),
    "a row beside a struct": (
        [STRUCT, (OBSERVE, OBSERVE.replace("observe", "observe_more")),
         ("class Tiny", f"{struct_of(PART)}\n\nclass Tiny")],
        "there is no obs: .* or let observe_more take a struct of parts",
    ),
    "a part in World": (
        [tiny_task.field("x: Row[float] = lw.part()")],
        r"World\.x is declared by lw\.part: use lw\.memory",
    ),
    "a part that is not written": (
        [STRUCT, (f"@wp.func\n{OBSERVE}", struct_of("x: Row[float] = lw.part(2)"))],
        r"observe leaves x\[1\] of obs unwritten",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("changes", "message"), MISTAKES.values(), ids=MISTAKES)
def test_invalid_part_raises_a_one_line_error_that_names_it(
    changes: list[tuple[str, str]], message: str, tmp_path: Path
) -> None:
    tiny_task.check_mistake(tmp_path, changes, message)
