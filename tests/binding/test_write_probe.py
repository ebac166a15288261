"""Detect functions that write out of range, before they damage memory."""

import subprocess
import sys
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
"""For each function: the parameter value that selects it, the size and name of the array that it writes, and what the
error says about this size."""

PROGRAM = """
import sys
import lyceum_warp as lw

for line in sys.stdin:
    function, index = map(int, line.split())
    try:
        lw.make(sys.argv[1], nworld=2, function=function, index=index)
    except ValueError as error:
        print(error)
    else:
        print("made")
"""


def test_writes_out_of_range_raise_an_error_before_they_damage_the_heap() -> None:
    cases, messages = [], []
    for name, (number, size, row, declared) in ROWS.items():
        function, into, of = name.split()[0], row and f" into {row}", row and f" of {row}"
        ends = [(size, f"{size + 1} numbers{into}"), (-size - 1, f"at index {-size - 1}{of}")]
        # the first function also writes far beyond its array, and the others write beyond one of their ends
        tried = ends[number % 2 :][:1] if cases else [*ends, (size + 999, f"{size + 1000} numbers{into}")]
        for index, text in tried:
            cases.append(f"{number} {index}")
            messages.append(f"{function} of the task 'out_of_range' writes {text}, but {declared}")
    run = subprocess.run(
        [sys.executable, "-c", PROGRAM, str(TASK)], input="\n".join([*cases, "1 0"]), capture_output=True, text=True,
        check=False,
    )  # fmt: skip
    assert (run.stdout.splitlines(), run.returncode) == ([*messages, "made"], 0), run.stderr[-2000:]


@pytest.mark.parametrize("index", [0, 5, -1, -6])
def test_positive_and_negative_indices_within_an_array_are_accepted(index: int) -> None:
    env = lw.make(str(TASK), function=10, index=index)
    env.reset()
    assert env.field("qpos")[0, index] == 1.0
