"""Compare tasks with dm_control's suite, on the C engine.

dm_control 1.0.50 does not run on MuJoCo 4, so ``store_dm_control.py`` stored episodes with MuJoCo 3.17. For these
models, the results of both releases differ only by rounding to float32.
"""

import functools
import importlib
import warnings
from collections.abc import Mapping
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from checks import check_same_distribution
from conftest import SharedEnv

import lyceum_warp as lw
from lyceum_warp.tasks.dm import TASKS

DATA = Path(__file__).parent.parent / "data" / "dm_control"
LAST_SUBSTEP = ("touch", "imu", "force_torque")
"""Parts of the observation that only a substep can compute."""
RESETS = 512
DOMAINS = {name: module.removeprefix("dm_") for module, names in TASKS.items() for name in names}
quick = pytest.mark.quick("dm/cartpole_swingup", "dm/finger_turn_hard", "dm/manipulator_bring_ball", "dm/walker_walk")


@functools.cache
def stored(task: str) -> dict[str, np.ndarray]:
    domain = DOMAINS[task]
    name = task.removeprefix(f"dm/{domain}_")
    with np.load(DATA / f"{domain}.npz") as file:
        return {key.removeprefix(f"{name}/"): file[key] for key in file.files if key.startswith(f"{name}/")}


def rows(task: str, name: str) -> np.ndarray:
    values = stored(task)[name]
    return values.reshape(values.shape[0] * values.shape[1], *values.shape[2:])


def segments(shared_env: SharedEnv, task: str) -> lw.Env:
    qpos = rows(task, "qpos")
    env = shared_env(task, nworld=len(qpos), autoreset=False)
    state = env.get_state()
    parts = env.state_space.split(state)
    parts["qacc_warmstart"].zero_()
    for name in ("qpos", "qvel", "act"):
        if name in parts:
            parts[name].copy_(torch.from_numpy(rows(task, name)))
    if env.model.nmocap:
        target = torch.from_numpy(rows(task, "target"))
        parts["mocap_pos"].copy_(target[:, :3])
        if target.shape[1] == 7:
            parts["mocap_quat"].copy_(target[:, 3:])
    env.set_state(state)
    env.action.copy_(torch.from_numpy(rows(task, "action")))
    return env


def current_columns(task: str) -> np.ndarray:
    values = stored(task)
    return np.repeat([part not in LAST_SUBSTEP for part in values["parts"]], values["sizes"])


ARGUMENTS: Mapping[str, tuple[object, ...]] = {
    "dm/manipulator_bring_ball": (False, False),
    "dm/quadruped_run": (100.0,),
    "dm/quadruped_walk": (10.0,),
    "dm/swimmer_swimmer15": (15,),
    "dm/swimmer_swimmer6": (6,),
}
FIELDS = (
    "body_mass body_inertia body_pos body_quat body_ipos body_iquat body_invweight0 "
    "geom_type geom_size geom_pos geom_quat geom_friction geom_contype geom_conaffinity geom_condim geom_solref "
    "geom_solimp geom_margin geom_fluid site_pos site_quat site_size site_type jnt_type jnt_axis jnt_pos jnt_range "
    "jnt_limited jnt_stiffness jnt_solref jnt_solimp actuator_gear actuator_gainprm actuator_biasprm actuator_dynprm "
    "actuator_ctrlrange tendon_stiffness tendon_range tendon_lengthspring eq_solref eq_solimp"
).split()
KINDS = {
    "body": ("BODY", "nbody"), "geom": ("GEOM", "ngeom"), "site": ("SITE", "nsite"), "jnt": ("JOINT", "njnt"),
    "actuator": ("ACTUATOR", "nactuator"), "tendon": ("TENDON", "ntendon"), "eq": ("EQUALITY", "neq"),
}  # fmt: skip


def dm_controls_model(task: str) -> mujoco.MjModel:
    module = importlib.import_module(f"dm_control.suite.{DOMAINS[task]}")
    make = getattr(module, "make_model", None) or module.get_model_and_assets
    made = make(*ARGUMENTS.get(task, ()))
    xml = made[0] if isinstance(made, tuple) else made
    assets = importlib.import_module("dm_control.suite.common").ASSETS
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # MuJoCo warns that cheetah's settotalmass is deprecated
        return mujoco.MjModel.from_xml_string(xml if isinstance(xml, str) else xml.decode(), assets)


@quick
@pytest.mark.parametrize("task", DOMAINS)
def test_model_equals_the_model_of_dm_control(shared_env: SharedEnv, task: str) -> None:
    ours, theirs = shared_env(task, nworld=len(rows(task, "qpos")), autoreset=False).model, dm_controls_model(task)
    for field in FIELDS:
        kind, count = KINDS[field.partition("_")[0]]
        named = [
            {mujoco.mj_id2name(model, getattr(mujoco.mjtObj, f"mjOBJ_{kind}"), i): row for i, row in enumerate(rows_)}
            for model in (ours, theirs)
            for rows_ in [getattr(model, field)]
        ]
        assert named[1].keys() <= named[0].keys() and getattr(theirs, count) == len(getattr(theirs, field))
        for name in named[1].keys() - {"target"}:  # which episodes move
            np.testing.assert_allclose(named[0][name], named[1][name], rtol=1e-9, atol=1e-12, err_msg=f"{field} {name}")
    for field in ("dof_armature", "dof_frictionloss", "dof_M0", "qpos0", "qpos_spring"):
        np.testing.assert_allclose(getattr(ours, field), getattr(theirs, field), rtol=1e-9, atol=1e-12, err_msg=field)
    # this package adds keyframes for estimating the sizes of MuJoCo Warp's buffers
    np.testing.assert_allclose(ours.key_qpos[: theirs.nkey], theirs.key_qpos, rtol=1e-9, atol=1e-12)
    damping = theirs.dof_damping.copy()
    if task == "dm/finger_spin":  # dm_control sets this field at each reset
        damping[2] = 0.03
    np.testing.assert_allclose(ours.dof_damping, damping)
    for field in ("timestep", "integrator", "cone", "gravity", "density", "viscosity"):
        assert np.array_equal(getattr(ours.opt, field), getattr(theirs.opt, field)), field
    # this package disables sensors that a task does not read
    without_sensors = ours.opt.disableflags & ~int(mujoco.mjtDisableBit.mjDSBL_SENSOR)
    assert without_sensors == theirs.opt.disableflags


@quick
@pytest.mark.parametrize("task", DOMAINS)
def test_task_has_the_sizes_and_time_steps_of_dm_control(shared_env: SharedEnv, task: str) -> None:
    env, theirs = shared_env(task, nworld=len(rows(task, "qpos")), autoreset=False), stored(task)
    sizes = {name: part.stop - part.start for name, part in env.obs_space.parts.items()}
    assert list(sizes.items()) == list(zip(theirs["parts"].tolist(), theirs["sizes"].tolist(), strict=True))
    assert env.timestep == pytest.approx(theirs["control_timestep"])
    assert env.model.opt.timestep == pytest.approx(theirs["timestep"])
    np.testing.assert_allclose(env.action_space.low, theirs["minimum"])
    np.testing.assert_allclose(env.action_space.high, theirs["maximum"])
    assert (theirs["step_type"] == [0, *(env.task.definition.horizon - 1) * [1], 2]).all()
    assert (theirs["discount"] == 1).all()


@quick
@pytest.mark.parametrize("task", DOMAINS)
def test_observations_and_rewards_in_stored_states_equal_those_of_dm_control(shared_env: SharedEnv, task: str) -> None:
    env = segments(shared_env, task)
    state, columns = env.get_state(), current_columns(task)
    np.testing.assert_allclose(
        env.get_obs(state)[:, columns], rows(task, "observation")[:, columns], rtol=1e-5, atol=2e-6
    )
    rewards = env.get_reward(state, env.action, state)
    np.testing.assert_allclose(rewards, rows(task, "reward"), rtol=1e-5, atol=2e-6)


@quick
@pytest.mark.parametrize("task", DOMAINS)
def test_step_from_a_stored_state_gives_the_results_of_dm_control(shared_env: SharedEnv, task: str) -> None:
    env = segments(shared_env, task)
    env.step()
    check_positions(env, rows(task, "next_qpos"), "qpos")
    check_positions(env, rows(task, "next_qvel"), "qvel")
    columns, wanted = current_columns(task), rows(task, "next_observation")
    np.testing.assert_allclose(env.obs[:, columns], wanted[:, columns], rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(env.obs[:, ~columns], wanted[:, ~columns], rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(env.reward, rows(task, "next_reward"), rtol=1e-5, atol=1e-5)


def check_positions(env: lw.Env, wanted: np.ndarray, name: str) -> None:
    found = env.state_space.split(env.get_state())[name].numpy()
    error = np.abs(found - wanted).max(1)
    print(f"{env.task.name} {name}: {np.quantile(error, [0.5, 0.95, 1.0])}")
    np.testing.assert_allclose(found, wanted, rtol=2e-7, atol=1e-6)


@pytest.mark.long
@pytest.mark.parametrize("task", DOMAINS)
def test_forty_steps_give_the_final_states_of_dm_control(shared_env: SharedEnv, task: str) -> None:
    env = segments(shared_env, task)
    for _ in range(40):
        env.step()
    check_positions(env, rows(task, "end_qpos"), "qpos")


@quick
@pytest.mark.parametrize("task", DOMAINS)
def test_initial_states_have_the_distribution_of_dm_control(shared_env: SharedEnv, task: str) -> None:
    theirs = stored(task)
    env = lw.make(task, nworld=RESETS)
    env.rand_reset(seed=1)
    parts = env.state_space.split(env.get_state())
    pairs = {name: (theirs[f"reset_{name}"], parts[name].numpy()) for name in ("qpos", "qvel", "act") if name in parts}
    if env.model.nmocap:
        target = theirs["reset_target"]
        found = np.concatenate([parts["mocap_pos"].numpy(), parts["mocap_quat"].numpy()], 1)
        pairs["target"] = target, found[:, : target.shape[1]]
    for wanted, found in pairs.values():
        check_same_distribution(wanted, found)


def test_margin_of_point_mass_is_the_size_of_its_target() -> None:
    env = lw.make("dm/point_mass_easy", target_size=0.1)
    assert env.task.params["margin"] == env.task.params["target_size"] == pytest.approx(0.1)


def test_energy_weight_of_acrobot_rewards_energy_but_not_a_spinning_lower_arm(shared_env: SharedEnv) -> None:
    env = shared_env("dm/acrobot_swingup", nworld=4, autoreset=False, energy_weight=2.0)
    state = env.get_state()
    parts = env.state_space.split(state)
    parts["qpos"].copy_(torch.tensor([[0.0, 0.0]] + 3 * [[torch.pi, 0.0]]))
    # 20 J of a swing, and 16 J of a spin
    parts["qvel"].copy_(torch.tensor([[0.0, 0.0], [0.0, 0.0], [3.85, 0.0], [-6.28, 20.0]]))
    rewards = env.get_reward(state, env.action, state)
    np.testing.assert_allclose(rewards, [3.0, 0.0, 1.0, 0.0], atol=0.1)


def test_spin_margin_rewards_velocities_below_the_target_velocity(shared_env: SharedEnv) -> None:
    env = shared_env("dm/finger_spin", nworld=3, autoreset=False, spin_margin=30.0)
    state = env.get_state()
    env.state_space.split(state)["qvel"][:, 2] = torch.tensor([-16.0, 0.0, 15.0])
    np.testing.assert_allclose(env.get_reward(state, env.action, state), [1.0, 0.5, 0.0], atol=1e-6)
