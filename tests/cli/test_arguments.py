import dataclasses

import pytest

from lyceum_warp.cli.arguments import NO_FLAGS, EnvFlags, Physics, Placement, given, parameter, parameters
from lyceum_warp.core import EnvOptions, PhysicsOptions


@pytest.mark.parametrize("text, value", [
    ("a=1", 1), ("a=-0.5", -0.5), ("a=1e-3", 1e-3), ("a=inf", float("inf")), ("a=true", True), ("a=False", False),
    ("a=0.7,inf", [0.7, float("inf")]), ("a=[1, 2]", [1, 2]),
])  # fmt: skip
def test_parameter_values_are_parsed_by_their_type(text: str, value: object) -> None:
    name, parsed = parameter(text)
    assert (name, parsed) == ("a", value)
    assert type(parsed) is type(value)


@pytest.mark.parametrize("text", ["mass", "mass=", "mass=heavy"])
def test_malformed_parameter_raises_an_error(text: str) -> None:
    with pytest.raises(ValueError, match=f"'{text}'"):
        parameter(text)


def test_every_option_has_a_flag_or_is_listed() -> None:
    physics = {field.name for field in dataclasses.fields(PhysicsOptions)} - {"base"} | {"physics"}
    assert {field.name for field in dataclasses.fields(Physics)} == physics
    names = {field.name for field in dataclasses.fields(EnvOptions)} - {*NO_FLAGS}
    assert {field.name for field in dataclasses.fields(EnvFlags)} == names
    assert {field.name for field in dataclasses.fields(Placement)} == names - {"horizon"}
    assert given(Physics()) == given(EnvFlags()) == {}


def test_last_value_of_a_repeated_parameter_is_used() -> None:
    assert parameters(["mass=1", "size=1,2", "mass=3"]) == {"mass": 3, "size": [1, 2]}


def test_option_given_as_a_parameter_raises_an_error() -> None:
    with pytest.raises(ValueError, match=r"horizon is an option.*--help-all"):
        parameters(["mass=1", "horizon=9"])
