import mujoco
import pytest
import tyro
from conftest import SharedEnv

import lyceum_warp as lw
from lyceum_warp.cli.arguments import Physics, given
from lyceum_warp.tuning.candidates import Setting, candidates, combined, flags, task_line


def test_settings_for_hopper_lower_the_solver_limits_and_keep_the_time_step(shared_env: SharedEnv) -> None:
    env = shared_env("hopper", solver={"iterations": 3})  # hopper uses RK4 and 4 substeps of 2 ms
    settings = candidates(env)
    names = [setting.name for setting in settings]
    assert [name for name in names if name.startswith("iterations")] == ["iterations=2", "iterations=1"]
    assert {"cone elliptic", "euler", "implicitfast", "discrete", "jacobian sparse"} <= set(names)
    assert [name for name in names if " x " in name] == [
        "2 x 4 ms", "2 x 4 ms, implicitfast", "2 x 4 ms, discrete", "1 x 8 ms", "1 x 8 ms, implicitfast",
        "1 x 8 ms, discrete",
    ]  # fmt: skip
    assert all(
        setting.physics["frame_skip"] * setting.physics["timestep"] == pytest.approx(env.timestep, rel=1e-9)
        for setting in settings
        if setting.group == "substeps"
    )
    limited = next(setting for setting in settings if setting.name == "ls_iterations=10")
    assert limited.physics == {"solver": {"iterations": 3, "ls_iterations": 10}}
    assert not {"noslip", "impratio", "room"} & {setting.group for setting in settings}


def test_settings_include_the_elliptic_cone_and_noslip(shared_env: SharedEnv) -> None:
    spec = lw.gymnasium_model("hopper.xml").spec()
    spec.option.cone, spec.option.impratio = mujoco.mjtCone.mjCONE_ELLIPTIC, 10
    spec.option.noslip_iterations = 5
    found = {setting.name: setting.physics for setting in candidates(shared_env("hopper", model=spec))}
    assert found["impratio=1"] == {"impratio": 1.0} and "cone pyramidal" in found
    assert found["noslip_iterations=0"] == {"solver": {"noslip_iterations": 0}}


def test_settings_of_the_warp_engine_include_half_of_its_buffers(shared_env: SharedEnv) -> None:
    env = shared_env("point_mass", engine="warp", nconmax=10, njmax=30)
    rooms = [setting.physics for setting in candidates(env) if setting.group == "room"]
    assert rooms == [{"nconmax": 5, "njmax": 15}]


LIMITED = Setting("iterations=2", "iterations", {"solver": {"iterations": 2}})
SEARCH = Setting("ls_iterations=5", "ls_iterations", {"solver": {"ls_iterations": 5}})
EULER = Setting("euler", "integrator", {"integrator": "euler"})
COARSE = Setting("1 x 8 ms, implicitfast", "substeps",
                 {"frame_skip": 1, "timestep": 0.008, "integrator": "implicitfast"})  # fmt: skip


def test_combination_has_at_most_one_setting_of_each_group_and_no_conflicts() -> None:
    finer = Setting("2 x 4 ms", "substeps", {"frame_skip": 2, "timestep": 0.004})
    both = combined([COARSE, EULER, LIMITED, finer, SEARCH])
    assert both is not None and both.parts == (COARSE, LIMITED, SEARCH)
    assert both.physics == {**COARSE.physics, "solver": {"iterations": 2, "ls_iterations": 5}}
    assert combined([COARSE, EULER, finer]) is None and combined([]) is None


def test_printed_flags_and_printed_python_line_select_the_setting() -> None:
    both = combined([COARSE, LIMITED, SEARCH])
    assert both is not None
    wanted = lw.PhysicsOptions(**both.physics)
    words = given(tyro.cli(tyro.conf.OmitArgPrefixes[Physics], args=flags(both.physics).split()))
    assert lw.PhysicsOptions(**words) == wanted
    scope = {"lw": lw}
    exec(task_line(both.physics), scope)
    assert scope["physics"]["fast"] == wanted  # type: ignore[index]
