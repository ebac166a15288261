from pathlib import Path

import pytest

import lyceum_warp as lw

TASK = Path(__file__).with_name("out_of_range_task.py")

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
            lw.make(str(TASK), nworld=2, function=number, index=index)
        assert str(caught.value) == f"{name.split()[0]} of the task 'out_of_range' writes {text}, but {declared}"


@pytest.mark.parametrize("index", [0, 5, -1, -6])
def test_positive_and_negative_indices_within_an_array_are_accepted(index: int) -> None:
    env = lw.make(str(TASK), function=10, index=index)
    env.reset()
    assert env.field("qpos")[0, index] == 1.0
