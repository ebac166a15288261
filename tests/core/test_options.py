import dataclasses
import inspect

import pytest

import lyceum_warp as lw
from lyceum_warp.binding import find_task
from lyceum_warp.core import OPTIONS, EnvOptions, PhysicsOptions
from lyceum_warp.core.options import suggestion


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"nworld": 0}, "nworld must be a whole number from 1 to 2147483647, not 0"),
        ({"seed": -1}, "seed must be a whole number from 0 .*, not -1"),
        ({"horizon": -3}, "horizon must be a whole number from 0 .*, not -3"),
        ({"autoreset": "no"}, "autoreset must be True or False, not 'no'"),
        ({"graphs": 1}, "graphs must be True or False, not 1"),
        ({"fields": "sensordata"}, r"fields must be names of fields, as in fields=\['sensordata'\], not 'sensordata'"),
        ({"fields": ["qpos", 3]}, r"fields must be names of fields, .* not \['qpos', 3\]"),
        ({"frame_skip": 0}, "frame_skip must be a whole number from 1 .*, not 0"),
        ({"timestep": 0.0}, "timestep must be a positive number of seconds, not 0.0"),
        ({"timestep": float("inf")}, "timestep must be a positive number of seconds, not inf"),
        ({"impratio": 0}, "impratio must be a finite number of at least 1e-15, not 0"),
        ({"jacobian": "full"}, "jacobian must be 'dense', 'sparse' or 'auto', not 'full'"),
        ({"cone": "round"}, "cone must be 'pyramidal' or 'elliptic', not 'round'"),
        ({"integrator": "rk5"}, "integrator must be 'euler', .* or 'discrete', not 'rk5'"),
        ({"solver": 4}, r"solver must be a dict of limits, such as solver=\{'iterations': 4\}, not 4"),
        ({"solver": {"itrations": 4}}, "there is no solver limit 'itrations': use 'iterations', 'ls_iterations'"),
        ({"solver": {"iterations": 0}}, "solver's iterations must be a whole number from 1 .*, not 0"),
        ({"deterministic": 0}, "deterministic must be True or False, not 0"),
        ({"device": 0}, "device must be .* as 'cpu' or 'cuda:0', not int 0"),
        ({"engine": None}, "engine must be .* not NoneType None"),
        ({"model": 3}, "model must be .* a file or an MjSpec, not int 3"),
        ({"physics": 3}, "physics must be of type PhysicsOptions, as lw.PhysicsOptions.*, not int 3"),
    ],
)  # fmt: skip
def test_option_out_of_range_raises_an_error_that_names_the_value(options: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        EnvOptions.split(options)


def test_keyword_arguments_are_split_into_options_physics_and_parameters() -> None:
    options, params = EnvOptions.split({"nworld": 4, "cone": "elliptic", "ctrl_cost_weight": 0.1})
    assert options == EnvOptions(nworld=4, physics=PhysicsOptions(cone="elliptic"))
    assert params == {"ctrl_cost_weight": 0.1}
    assert options.given() == {"nworld": 4, "cone": "elliptic"}


def test_options_of_a_wrong_type_raise_an_error() -> None:
    with pytest.raises(ValueError, match=r"lw.EnvOptions\(nworld=64\), not dict"):
        lw.Env("hopper", {"nworld": 3})  # type: ignore[arg-type]


def test_options_object_and_keyword_options_give_equal_environments() -> None:
    options = EnvOptions(nworld=2, horizon=5, physics=PhysicsOptions(integrator="euler"))
    for env in (lw.Env("hopper", options), lw.make("hopper", nworld=2, horizon=5, integrator="euler")):
        assert env.options == options
        assert (env.nworld, env.horizon) == (2, 5)


FAST = PhysicsOptions(integrator="implicitfast", timestep=0.004, frame_skip=2)
Fast = type("Fast", (find_task("hopper"),), {"physics": {"fast": FAST}})


def test_keyword_arguments_override_the_options_of_named_physics() -> None:
    env = lw.make(Fast, physics="fast")
    assert env.options.physics == FAST and env.options.given() == FAST.given() and env.timestep == 0.008
    assert env.model.opt.timestep == 0.004 and env.replicate(physics="exact").options.physics == PhysicsOptions()
    assert lw.make(Fast).options.physics == PhysicsOptions()
    for given in ({"physics": "fast", "cone": "elliptic"}, {"physics": PhysicsOptions(base="fast", cone="elliptic")}):
        assert lw.make(Fast, **given).options.physics == dataclasses.replace(FAST, cone="elliptic")
    named = {"fast": PhysicsOptions(deterministic=True)}
    for given, wanted in ((None, True), (False, None)):
        assert PhysicsOptions(base="fast", deterministic=given).resolved(named).deterministic is wanted
    assert EnvOptions().changed({"physics": "fast", "deterministic": False}).physics.deterministic is False
    with pytest.raises(ValueError, match="there is no physics 'quick': use 'exact', 'fast'$"):
        lw.make(Fast, physics="quick")
    with pytest.raises(ValueError, match="base must be .* as 'exact', not int 3"):
        PhysicsOptions(base=3)  # type: ignore[arg-type]


def test_planner_uses_named_physics_from_its_arguments_or_from_task_planning() -> None:
    assert lw.MPPI(Fast, horizon=2, samples=2, physics="fast").settings["timestep"] == 0.004
    planned = type("Planned", (Fast,), {"planning": lw.Planning(options={"physics": "fast"})})
    plan = lw.MPPI(planned, horizon=2, samples=2)
    assert plan.env.options.physics == FAST and plan.settings["frame_skip"] == 2 and "base" not in plan.settings
    assert lw.MPPI(planned, horizon=2, samples=2, physics="exact").env.options.physics == PhysicsOptions()
    planned.planning = lw.Planning(options={"physics": "quick"})
    with pytest.raises(ValueError, match="planning of the task 'planned': there is no physics 'quick'"):
        lw.MPPI(planned)


def test_replica_has_the_options_of_the_original_except_for_given_changes() -> None:
    env = lw.make("hopper", nworld=2, horizon=5, integrator="euler", solver={"iterations": 4}, seed=3)
    replica = env.replicate(nworld=3, horizon=6)
    assert replica.options.given() == {
        "nworld": 3, "horizon": 6, "integrator": "euler", "solver": {"iterations": 4},
        "model": env.task.spec,  # the replica has the loaded spec even if the file has changed since
    }  # fmt: skip


@pytest.mark.parametrize(
    ("word", "expected"),
    [
        ("nworlds", "did you mean nworld?"),
        ("num_envs", "did you mean nworld?"),
        ("record", "did you mean graphs?"),
        ("ls_iterations", "did you mean solver={'ls_iterations': ...}?"),
        ("qqq", ""),
    ],
)
def test_misspelt_option_names_get_a_suggestion(word: str, expected: str) -> None:
    assert suggestion(word) == expected


def test_make_has_an_argument_of_the_same_type_and_default_for_every_option() -> None:
    arguments = dict(inspect.signature(lw.make).parameters)
    fields = [field for kind in (EnvOptions, PhysicsOptions) for field in dataclasses.fields(kind)]
    fields = [field for field in fields if field.name != "base"]  # the argument physics="fast" sets this option
    assert list(OPTIONS) == [field.name for field in fields] == [*arguments][1:-1]
    for name, default in {field.name: field.default for field in fields}.items():
        assert arguments[name].default == (None if name == "physics" else default), name
