import pytest
import warp as wp
from rail_task import Picky

import lyceum_warp as lw
from lyceum_warp import Row


@wp.struct
class World:
    qpos: Row[float]
    xpos: Row[wp.vec3]
    qfrc_applied: Row[float]
    body_mass: Row[float]
    counts: Row[float] = lw.memory(2)
    level: Row[float] = lw.lasting_memory(3)


@wp.struct
class Params:
    dt: float
    function: int = 0
    index: int = 0


@wp.func
def observe(s: World, p: Params, obs: Row[float]):
    obs[0] = s.qpos[0]
    if p.function == 1:
        obs[p.index] = 1.0
    if p.function == 20:
        obs[0] = s.qpos[p.index]


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    result = float(0.0)
    if p.function == 22:
        result = action[p.index]
    return result


@wp.func
def terminated(s: World, p: Params) -> bool:
    return p.function == 23 and s.xpos[p.index][0] > 0.0


@wp.func
def observe_critic(s: World, p: Params, obs: Row[float]):
    if p.function == 21:
        obs[0] += 1.0
    else:
        obs[0] = s.qpos[0]
    obs[1] = s.qpos[1]
    if p.function == 2:
        obs[p.index] += 1.0


@wp.func
def measure(s0: World, action: Row[float], s1: World, p: Params, metrics: Row[float]):
    metrics[0] = s1.qpos[0]
    if p.function == 3:
        metrics[p.index] = 1.0


@wp.func
def control(s: World, action: Row[float], p: Params, ctrl: Row[float]):
    for i in range(3):
        ctrl[i] = action[i]
    if p.function == 24:
        ctrl[0] = action[p.index]
    if p.function == 4:
        ctrl[p.index] = 1.0
    if p.function == 5:
        s.qfrc_applied[p.index] = 1.0


@wp.func
def substep(s: World, p: Params):
    if p.function == 6:
        s.counts[p.index] = 1.0


@wp.func
def advance(s0: World, action: Row[float], s1: World, p: Params, rng: Row[wp.uint32]):
    if p.function == 25:
        s1.counts[0] = s0.level[p.index]
    if p.function == 7:
        s1.counts[p.index] = 1.0


@wp.func
def event(s: World, p: Params, rng: Row[wp.uint32]):
    if p.function == 8:
        s.level[p.index] = 1.0


@wp.func
def startup(s: World, p: Params, rng: Row[wp.uint32]):
    if p.function == 9:
        s.body_mass[p.index] = 1.0


@wp.func
def initialize(s: World, p: Params):
    if p.function == 10:
        s.qpos[p.index] = 1.0


@wp.func
def randomize(s: World, p: Params, rng: Row[wp.uint32]):
    if p.function == 26:
        s.qpos[0] = s.body_mass[p.index]
    if p.function == 11:
        s.qpos[p.index] = 1.0
    if p.function == 12:
        rng[p.index] = wp.uint32(1)


class OutOfRange(lw.Task):
    model = "hopper.xml"
    obs = {"policy": {"x": 1}, "critic": {"x": 2}}
    metrics = ("x",)


ROWS = {
    "observe": (1, 1, "", "obs declares 1"),
    "observe_critic": (2, 2, "", "obs declares 2"),
    "measure": (3, 1, "", "metrics names ['x']"),
    "control": (4, 3, "ctrl", "the model has 3"),
    "control of an input": (5, 6, "qfrc_applied", "the model has 6"),
    "substep": (6, 2, "counts", "World declares 2"),
    "advance": (7, 2, "counts", "World declares 2"),
    "event": (8, 3, "level", "World declares 3"),
    "startup": (9, 5, "body_mass", "the model has 5"),
    "initialize": (10, 6, "qpos", "the model has 6"),
    "randomize": (11, 6, "qpos", "the model has 6"),
    "randomize of a stream": (12, 1, "rng", "a stream has 1"),
}


@pytest.mark.parametrize("name", ROWS)
def test_write_out_of_range_raises_an_error_before_it_damages_the_heap(name: str) -> None:
    number, size, row, declared = ROWS[name]
    into, of = (row and f" {word} {row}" for word in ("into", "of"))
    for index, text in (
        (size, f"{size + 1} numbers{into}"),
        (size + 999, f"{size + 1000} numbers{into}"),
        (-size - 1, f"at index {-size - 1}{of}"),
    ):
        with pytest.raises(ValueError, match="out_of_range") as caught:
            lw.make(OutOfRange, nworld=2, function=number, index=index)
        assert str(caught.value) == f"the task 'out_of_range': {name.split()[0]} writes {text}, but {declared}"


@pytest.mark.parametrize(
    ("function", "number", "size"),
    [("observe", 20, 6), ("observe_critic", 21, 0), ("reward", 22, 3), ("terminated", 23, 5), ("control", 24, 3),
     ("advance", 25, 3), ("randomize", 26, 5)],
)  # fmt: skip
def test_read_out_of_range_or_of_unwritten_memory_raises_an_error(function: str, number: int, size: int) -> None:
    with pytest.raises(ValueError, match=f": {function} reads out of range"):
        lw.make(OutOfRange, nworld=2, function=number, index=size)


@pytest.mark.parametrize("index", [0, 5, -1, -6])
def test_positive_and_negative_indices_within_an_array_are_accepted(index: int) -> None:
    env = lw.make(OutOfRange, function=10, index=index)
    env.reset()
    assert env.field("qpos")[0, index] == 1.0


def test_function_may_return_not_a_number_from_the_start() -> None:
    env = lw.make(Picky, limit=-1.0)
    env.step()
    assert env.fault_counts["reward"] == 1
