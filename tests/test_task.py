"""The table of a task's functions, and names of elements of the model."""

import pytest

import lyceum_warp as lw
from lyceum_warp.binding.registry import find_task
from lyceum_warp.task import FUNCTIONS, Element, TaskFunction


def test_only_observe_is_required() -> None:
    assert [function.name for function in FUNCTIONS.values() if function.default is None] == ["observe"]


def test_a_signature_is_the_line_that_defines_the_function() -> None:
    function = TaskFunction("height", "s: World, p: Params", float, "")
    assert function.signature == "height(s: World, p: Params) -> float"
    assert function.kinds == ("World", "Params")
    assert FUNCTIONS["observe"].signature == "observe(s: World, p: Params, obs: Row[float])"


@pytest.mark.parametrize("function", FUNCTIONS.values(), ids=FUNCTIONS)
def test_a_default_gives_the_functions_result(function: TaskFunction) -> None:
    if function.default is None:
        return
    assert function.default == {None: "pass", float: "return 0.0", bool: "return False"}[function.result]


@pytest.mark.parametrize(
    ("name", "field"),
    [
        ("site", "site_xpos"), ("body", "xpos"), ("geom", "geom_xpos"), ("qpos", "qpos"), ("dof", "qvel"),
        ("sensor", "sensordata"), ("mocap", "mocap_pos"),
    ],
)  # fmt: skip
def test_a_named_element_knows_its_field(name: str, field: str) -> None:
    element = getattr(lw, name)("tip")
    assert isinstance(element, Element) and isinstance(element, int)
    assert (element.field, element.name) == (field, "tip")


def test_a_task_keeps_the_structs_and_functions_of_its_module_when_it_was_made() -> None:
    assert {"World", "Params", "observe", "reward"} <= set(find_task("hopper").scope)
