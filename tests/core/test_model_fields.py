import mujoco
import pytest
import warp as wp

from lyceum_warp.core import gymnasium_model, vec10
from lyceum_warp.core.model_fields import Constants, describe_model_field

ANT = gymnasium_model("ant.xml").spec().compile()


@pytest.mark.parametrize(
    ("name", "shape", "dtype", "size"),
    [
        ("body_mass", (ANT.nbody,), wp.float32, ANT.nbody),
        ("geom_friction", (ANT.ngeom,), wp.vec3, 3 * ANT.ngeom),
        ("body_quat", (ANT.nbody,), wp.vec4, 4 * ANT.nbody),
        ("actuator_gainprm", (ANT.nu,), vec10, 10 * ANT.nu),
        ("gravity", (3,), wp.float32, 3),
        ("density", (1,), wp.float32, 1),
        ("tendon_stiffness", (0,), wp.float32, 0),
    ],
)
def test_model_field_has_the_type_of_its_elements(name: str, shape: tuple[int, ...], dtype: type, size: int) -> None:
    field = describe_model_field(ANT, name)
    assert (field.shape, field.dtype, field.size) == (shape, dtype, size)
    assert field.value(ANT).size == size


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("timestep", "the parameters dt and substep_dt"),
        ("body_invweight0", "computes it from other fields"),
        ("geom_type", "share"),
        ("actuator_ctrlrange", "controls are clipped to the model's own ranges"),
    ],
)
def test_randomizing_a_field_that_all_worlds_share_raises_an_error(name: str, reason: str) -> None:
    with pytest.raises(ValueError, match=f"{name!r} cannot differ between worlds: .*{reason}"):
        describe_model_field(ANT, name)


def test_task_may_read_shared_model_fields_that_have_rows_of_floats() -> None:
    assert describe_model_field(ANT, "actuator_ctrlrange", varies=False).dtype is wp.vec2
    for name, reason in (("nq", "make it a parameter"), ("opt", "rows"), ("timestep", "dt"), ("geom_type", "rows")):
        with pytest.raises(ValueError, match=f"{name!r} cannot be read in World: .*{reason}"):
            describe_model_field(ANT, name, varies=False)


def test_geom_positions_affect_constants_if_tendons_wrap_around_geoms() -> None:
    xml = """<mujoco><worldbody><geom name="g" size=".1"/><site name="a" pos="-1 0 0"/>
    <body pos="1 0 0"><joint axis="0 1 0"/><geom size=".1"/><site name="b"/></body></worldbody>
    <tendon><spatial><site site="a"/><geom geom="g"/><site site="b"/></spatial></tendon></mujoco>"""
    wrapped = mujoco.MjModel.from_xml_string(xml)
    assert Constants.INERTIAL in describe_model_field(wrapped, "geom_pos").constants
    assert Constants.INERTIAL not in describe_model_field(ANT, "geom_pos").constants
