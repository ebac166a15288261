from collections import defaultdict

import numpy as np
import pytest
from conftest import TaskFile
from term_calls import KERNELS

import lyceum_warp as lw
from lyceum_warp import terms


def test_argument_name_has_one_type_and_one_documented_meaning_in_all_functions() -> None:
    kinds = defaultdict(set)
    for overloads in KERNELS.values():
        for function, _ in overloads:
            for argument, kind in function.input_types.items():
                kinds[argument].add(str(kind))
    assert {argument for argument, found in kinds.items() if len(found) > 1} == {"row"}  # numbers or vectors
    assert {*kinds} == {*terms.ARGUMENTS}


TASK = """
import mujoco
import warp as wp

import lyceum_warp as lw
from lyceum_warp import Row, terms
from lyceum_warp.terms import gravity, upright


@wp.struct
class World:
    qpos: Row[float]
    qvel: Row[float]
    geom_friction: Row[wp.vec3]
    body_mass: Row[float]
    body_ipos: Row[wp.vec3]
    body_inertia: Row[wp.vec3]
    body_iquat: Row[lw.quat]


@wp.struct
class Params:
    geoms: wp.array[int] = [2, 1]
    box: int = lw.body("box")
    shape: wp.vec3 = wp.vec3(0.1, 0.1, 0.1)
    shift: wp.vec3 = wp.vec3(0.0, 0.01, 0.02)


@wp.func
def observe(s: World, p: Params, obs: Row[float], rng: Row[wp.uint32]):
    lw.put(obs, 0, terms.linear_velocity(s.qpos, s.qvel))
    {further}


@wp.func
def reward(s0: World, action: Row[float], s1: World, p: Params) -> float:
    return upright(gravity(s1.qpos), 0.2)


@wp.func
def startup(s: World, p: Params, rng: Row[wp.uint32]):
    terms.draw_friction(s.geom_friction, p.geoms, wp.vec2(0.3, 0.5), wp.vec2(0.001, 0.01), wp.vec2(1e-4, 1e-3), rng)
    terms.draw_inertia(
        s.body_mass, s.body_ipos, s.body_inertia, s.body_iquat, p.box, 0.1, p.shape, p.shape, p.shift, rng
    )


@wp.func
def event(s: World, p: Params, rng: Row[wp.uint32]):
    terms.push(s.qpos, s.qvel, wp.vec3(0.5), wp.vec3(0.5), rng)


class Box(lw.Task):
    obs = {"velocity": 3}

    @staticmethod
    def model() -> mujoco.MjSpec:
        return mujoco.MjSpec.from_string(
            "<mujoco><option gravity='0 0 0'/><worldbody><geom name='floor' type='plane' size='1 1 1' pos='0 0 -5'/>"
            "<body name='box' pos='0 0 1' simple='false'><freejoint name='free'/><geom size='.1 .2 .3' type='box'/>"
            "<geom size='.1' pos='.1 .2 .3'/></body></worldbody>"
            "<actuator><motor joint='free' gear='1'/></actuator></mujoco>"
        )
"""


def test_task_randomizes_and_pushes_robots_with_library_functions(task_file: TaskFile) -> None:
    source = TASK.replace("{further}", "terms.add_uniform_noise(obs, 0.01, rng)")
    env = lw.make(str(task_file("library_box.py", source)), nworld=16, horizon=0)
    env.rand_reset(seed=0)
    state = {name: part.numpy().copy() for name, part in env.state_space.split(env.get_state()).items()}
    friction = state["geom_friction"].reshape(16, 3, 3)
    assert (friction[:, 1] == friction[:, 2]).all() and len(np.unique(friction[:, 1, 0])) == 16
    np.testing.assert_allclose(friction[:, 0], np.tile(env.model.geom_friction[0], (16, 1)))
    assert len(np.unique(state["body_mass"][:, 1])) == 16
    velocity = np.zeros((16, 6))
    for _ in range(3):
        env.step()
        now = env.state_space.split(env.get_state())["qvel"].numpy().copy()
        assert (np.abs(now - velocity).max(axis=1) > 0.05).all()
        velocity = now
    assert np.isfinite(env.reward.numpy()).all()


def test_library_function_that_writes_a_read_only_field_raises_an_error(task_file: TaskFile) -> None:
    source = TASK.replace("{further}", "terms.push(s.qpos, s.qvel, wp.vec3(0.5), wp.vec3(0.5), rng)")
    with pytest.raises(ValueError, match=r"observe of the task .* writes s\.qvel in push \(pushes\.py, line \d+\)"):
        lw.make(str(task_file("library_push.py", source)), nworld=1)
