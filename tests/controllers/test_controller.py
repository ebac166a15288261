"""The protocols of a controller."""

import ast
import inspect

import pytest
from toy_controllers import StepPlanner, towards

import lyceum_warp as lw
from lyceum_warp.controllers import checked_controller
from lyceum_warp.controllers.controller import PlanningController


def members(protocol: type) -> set[str]:
    return {name for name in vars(protocol) if not name.startswith("_")}


def test_mppi_has_all_members_of_a_planning_controller() -> None:
    plan = lw.MPPI("point_mass", horizon=2, samples=1, nthread=1)
    assert isinstance(plan, PlanningController)
    assert inspect.signature(plan).parameters["shift"].kind is inspect.Parameter.KEYWORD_ONLY


def test_a_function_is_a_controller_without_those_members() -> None:
    assert not isinstance(towards, PlanningController)


def test_the_protocol_has_every_member_that_the_loops_use() -> None:
    calls = [node for node in ast.walk(ast.parse(inspect.getsource(checked_controller))) if isinstance(node, ast.Call)]
    gets = [node for node in calls if isinstance(node.func, ast.Name) and node.func.id == "getattr"]
    used = {ast.literal_eval(node.args[1]) for node in gets} - {"__name__"}
    assert used == members(PlanningController)


@pytest.mark.parametrize("name", sorted(members(PlanningController)))
def test_every_member_has_a_docstring(name: str) -> None:
    assert inspect.getdoc(getattr(PlanningController, name))


def test_members_are_optional() -> None:
    env = lw.make("point_mass", engine="mujoco", autoreset=False)
    planner = StepPlanner(env)
    assert not isinstance(planner, PlanningController)
    assert lw.control(env, planner, steps=2).steps == 2
