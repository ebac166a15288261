import dataclasses

import pytest

from lyceum_warp.cli.arguments import (
    NO_FLAGS,
    EnvFlags,
    Physics,
    Placement,
    given,
    parameter,
    parameters,
)
from lyceum_warp.cli.train import Train
from lyceum_warp.core import OPTIONS, EnvOptions, PhysicsOptions


@pytest.mark.parametrize("text, value", [
    ("a=1", 1), ("a=-0.5", -0.5), ("a=1e-3", 1e-3), ("a=inf", float("inf")), ("a=true", True), ("a=False", False),
    ("a=0.7,inf", [0.7, float("inf")]), ("a=[1, 2]", [1, 2]),
])  # fmt: skip
def test_parameter_values_are_parsed_by_their_type(text: str, value: object) -> None:
    name, parsed = parameter(text)
    assert (name, parsed) == ("a", value)
    assert type(parsed) is type(value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("mass", "'mass' must be written as NAME=VALUE"),
        ("mass=", "'mass=' must be written as NAME=VALUE"),
        ("mass=heavy", "the value in 'mass=heavy' must be a number, true or false"),
    ],
)
def test_malformed_parameter_raises_an_error(text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        parameter(text)


def test_every_physics_option_has_a_flag() -> None:
    names = [field.name for field in dataclasses.fields(Physics)]
    options = ["physics", *(field.name for field in dataclasses.fields(PhysicsOptions))]
    options.remove("base")
    assert sorted(names) == sorted(options) and given(Physics()) == {}


def test_every_environment_option_without_a_flag_is_listed() -> None:
    names = {field.name for field in dataclasses.fields(EnvOptions)}
    for flags, others in ((EnvFlags, set()), (Placement, {"horizon"})):
        assert {field.name for field in dataclasses.fields(flags)} == names - {*NO_FLAGS} - others
    assert vars(Placement()) == {"engine": "auto", "device": "cpu", "nthread": None}
    assert given(EnvFlags()) == {}


@pytest.mark.parametrize("name", [*OPTIONS])
def test_environment_option_given_as_param_raises_an_error(name: str) -> None:
    flags = {*dir(Train), *dir(EnvFlags), *dir(Physics)}
    way = f"use --{name.replace('_', '-')}" if name in flags else "this command has no flag for it"
    with pytest.raises(ValueError, match=f"^{name} is an option, not a parameter of the task: {way}$"):
        parameters(["mass=1", f"{name}=any"], Train())


def test_last_value_of_a_repeated_parameter_is_used() -> None:
    assert parameters(["mass=1", "size=1,2", "mass=3"], Train()) == {"mass": 3, "size": [1, 2]}
    with pytest.raises(ValueError, match="horizon is an option, not a parameter of the task: use --steps"):
        parameters(["horizon=9"], Train(), instead={"horizon": "--steps"})
