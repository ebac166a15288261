import pydoc
import re
from typing import Any

import pytest

import lyceum_warp as lw
from lyceum_warp.core import FUNCTIONS, Task
from lyceum_warp.support.docstrings import attribute_docs
from lyceum_warp.tasks.balance import balancing
from lyceum_warp.tasks.velocity import gait, rough, walking


def page(thing: object) -> str:
    return pydoc.plain(pydoc.render_doc(thing))


def test_help_of_task_shows_every_function_and_every_attribute() -> None:
    text = page(lw.Task)
    for function in FUNCTIONS.values():
        assert function.signature in text
    for name in (name for name in Task.__annotations__ if name != "scope"):
        assert f"{name}: " in text
    assert "w, x, y, z" in text  # the quaternion's order


@pytest.mark.parametrize("kind", [lw.Env, lw.Task, lw.NPGConfig, lw.Iteration, lw.OpenLoop, lw.Trajectory,
                                  lw.Planner, lw.MPPIConfig, lw.PlanSamples, lw.PlanUpdate, lw.Planning])  # fmt: skip
def test_help_shows_every_attribute_docstring(kind: type) -> None:
    docs, text = attribute_docs(kind), " ".join(page(kind).replace("|", " ").split())
    assert docs
    for name, doc in docs.items():
        assert f"{name}: {' '.join(doc.split())}" in text


@pytest.mark.parametrize("struct", [walking.Params, walking.BipedParams, gait.Params, rough.Params, balancing.Params])
def test_help_of_a_family_shows_the_meaning_of_every_parameter(struct: Any) -> None:
    text = " ".join(page(struct).split())
    docs = attribute_docs(*reversed(struct.cls.__mro__[:-1]))
    assert {*struct.vars} <= {*docs} and all(docs.values())
    for name, doc in docs.items():
        assert f"{name}: {doc}" in text


def test_help_of_every_public_function_shows_its_arguments() -> None:
    functions = {
        name: value for name in lw.__all__ if callable(value := getattr(lw, name)) and not isinstance(value, type)
    }
    assert len(functions) > 40
    functions |= {name: getattr(lw.terms, name) for name in lw.terms.__all__}
    for name, function in functions.items():
        text = page(function)
        assert f"{name}(" in text and "class Function(" not in text, name
        overloads = getattr(function, "user_overloads", {}).values()
        for parameter in {each for overload in overloads for each in overload.input_types}:
            assert re.search(rf"\b{parameter}\b", text), f"{name} has no {parameter}"
