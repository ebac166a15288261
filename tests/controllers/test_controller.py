import ast
import inspect

import lyceum_warp as lw
from lyceum_warp.controllers import checked_controller
from lyceum_warp.controllers.controller import PlanningController


def test_mppi_satisfies_the_protocol_of_planning_controllers() -> None:
    plan = lw.MPPI("point_mass", horizon=2, samples=1, nthread=1)
    assert isinstance(plan, PlanningController)
    assert inspect.signature(plan).parameters["shift"].kind is inspect.Parameter.KEYWORD_ONLY


def test_protocol_of_planning_controllers_has_every_attribute_that_the_loops_use() -> None:
    calls = [node for node in ast.walk(ast.parse(inspect.getsource(checked_controller))) if isinstance(node, ast.Call)]
    gets = [node for node in calls if isinstance(node.func, ast.Name) and node.func.id == "getattr"]
    used = {ast.literal_eval(node.args[1]) for node in gets} - {"__name__"}
    assert used == {name for name in vars(PlanningController) if not name.startswith("_")}
