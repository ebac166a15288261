from pathlib import Path

import mujoco
import pytest
import tiny_task

import lyceum_warp as lw
from lyceum_warp.binding import compile_model, find_task
from lyceum_warp.core import PhysicsOptions
from lyceum_warp.core.model_files import load_spec

BALL = (
    '<mujoco model="ball"><option {option}/><worldbody><body><freejoint/><geom size=".1"/></body></worldbody></mujoco>'
)
PHYSICS = PhysicsOptions()


def ball(option: str = "") -> mujoco.MjSpec:
    return mujoco.MjSpec.from_string(BALL.format(option=option))


# sources


def test_compiled_model_raises_an_error() -> None:
    with pytest.raises(ValueError, match="must be a file or an MjSpec, not a compiled MjModel: give its MjSpec"):
        load_spec(ball().compile())


@pytest.mark.parametrize(
    ("model", "message"),
    [
        ("/nowhere/hopper.xml", "there is no model file '/nowhere/hopper.xml'"),
        ("robott.xml", r"no model file .*robott.xml \(did you mean robot.xml\?\); among Gymnasium's models, "),
    ],
)
def test_error_of_a_missing_model_file_names_the_file(model: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "robot.xml").write_text("<mujoco/>")
    file = tiny_task.write(tmp_path, tiny_task.changed(("hopper.xml", model)))
    with pytest.raises(FileNotFoundError, match=message):
        lw.make(file)


# changes before compiling


def test_pgs_solver_is_replaced_by_newton() -> None:
    assert compile_model(ball('solver="PGS"'), (), PHYSICS).opt.solver == mujoco.mjtSolver.mjSOL_NEWTON
    assert compile_model(ball('solver="CG"'), (), PHYSICS).opt.solver == mujoco.mjtSolver.mjSOL_CG


def test_energy_is_computed_only_if_the_task_reads_it() -> None:
    assert compile_model(ball(), ["energy"], PHYSICS).opt.enableflags & mujoco.mjtEnableBit.mjENBL_ENERGY
    assert not compile_model(ball(), ["qpos"], PHYSICS).opt.enableflags & mujoco.mjtEnableBit.mjENBL_ENERGY


def test_physics_options_override_the_options_of_the_model() -> None:
    solver = {"iterations": 7, "ls_iterations": 9}
    physics = PhysicsOptions(
        timestep=0.015, cone="elliptic", integrator="implicitfast", solver=solver, jacobian="sparse", impratio=10
    )  # fmt: skip
    option = compile_model(ball('cone="pyramidal" integrator="RK4"'), (), physics).opt
    assert option.timestep == 0.015 and option.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
    assert option.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    assert (option.iterations, option.ls_iterations) == (7, 9)
    assert (option.jacobian, option.impratio) == (mujoco.mjtJacobian.mjJAC_SPARSE, 10.0)


def test_sensors_are_added_for_fields_that_need_them_and_otherwise_disabled() -> None:
    model = compile_model(ball(), ["qpos", "cfrc_ext", "subtree_linvel"], PHYSICS)
    kinds = [mujoco.mjtSensor.mjSENS_FRAMELINACC, mujoco.mjtSensor.mjSENS_SUBTREELINVEL]
    assert sorted(model.sensor_type) == sorted(map(int, kinds))
    assert not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_SENSOR
    model = compile_model(ball(), ["qpos"], PHYSICS)
    assert model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_SENSOR


# replicas


def test_replica_has_the_model_of_its_original_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spec = lw.gymnasium_model("hopper.xml").spec()
    env = lw.make("hopper", model=spec)
    spec.geom("torso_geom").density = 5000
    masses = iter((1000, 2000, 3000))

    def drawn() -> mujoco.MjSpec:
        spec = lw.gymnasium_model("hopper.xml").spec()
        spec.geom("torso_geom").density = next(masses)
        return spec

    class Drawn(find_task("hopper")):  # type: ignore[misc]
        model = staticmethod(drawn)

    for original in (env, lw.make(Drawn)):
        assert (original.replicate().model.body_mass == original.model.body_mass).all()
        original.get_obs(original.get_state())
        assert original._scratch is not None
        assert (original._scratch.model.body_mass == original.model.body_mass).all()
    assert env.replicate(model=spec).model.body_mass[1] > 2 * env.model.body_mass[1]


CUBE = """<mujoco><asset><mesh name="cube" file="cube.obj"/></asset>
<worldbody><body><joint name="hinge"/><geom type="mesh" mesh="cube"/></body></worldbody>
<actuator><motor joint="hinge"/></actuator></mujoco>"""
CORNERS = "".join(f"v {x} {y} {z}\n" for x in (-0.1, 0.1) for y in (-0.1, 0.1) for z in (-0.1, 0.1))


@pytest.mark.parametrize("as_spec", [False, True])
def test_relative_model_path_still_works_after_a_change_of_folder(
    as_spec: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "robot.xml").write_text(CUBE)
    (tmp_path / "cube.obj").write_text(CORNERS)
    monkeypatch.chdir(tmp_path)
    env = lw.make(tiny_task.write(tmp_path / "elsewhere", tiny_task.TINY),
                  model=mujoco.MjSpec.from_file("robot.xml") if as_spec else "robot.xml")  # fmt: skip
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert env.replicate().model.nmesh == 1


def test_error_of_a_model_given_as_xml_text_suggests_an_mjspec() -> None:
    with pytest.raises(
        ValueError, match=r"^the model '<mujoco><asset><mesh \.\.\.' is XML.*mujoco.MjSpec.from_string\(\.\.\.\)"
    ):
        load_spec(f"\n  {CUBE}")


def test_bodies_with_a_randomized_inertial_frame_are_not_simple() -> None:
    assert compile_model(ball(), (), PHYSICS).body_simple[1] == 1
    assert compile_model(ball(), (), PHYSICS, varied=["body_mass"]).body_simple[1] == 1
    assert compile_model(ball(), (), PHYSICS, varied=["body_ipos"]).body_simple[1] == 0


@pytest.mark.parametrize(("integrator", "warned"), [("euler", True), ("discrete", False)])
def test_servo_that_is_unstable_in_the_substep_is_named(
    integrator: str, warned: bool, caplog: pytest.LogCaptureFixture
) -> None:
    lw.make("go1_velocity", integrator=integrator, timestep=0.02, frame_skip=1)
    assert any("_calf" in message and "20 ms" in message for message in caplog.messages) == warned
