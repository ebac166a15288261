import mujoco
import numpy as np
import pytest
import torch
from checks import check_formula, check_uniform, positions, put_at_random
from conftest import SharedEnv

import lyceum_warp as lw

NWORLD = 256

BODIES = {  # parent body, position relative to it, mass, moments of inertia (capsules and spheres of 1,000 kg/m^3)
    "shoulder": ("world", (0, -0.6, 0), 24.311738, (1.2153105, 1.2145685, 0.1205579)),
    "lift": ("shoulder", (0.1, 0, 0), 10.471976, (0.1267109, 0.1267109, 0.0481711)),
    "upper_roll": ("lift", (0, 0, 0), 0.284838, (0.0012536, 0.0012536, 0.0000556)),
    "upper_arm": ("upper_roll", (0, 0, 0), 5.428672, (0.1100271, 0.1100271, 0.0094459)),
    "elbow": ("upper_arm", (0.4, 0, 0), 1.357168, (0.0029466, 0.0029466, 0.0021172)),
    "fore_roll": ("elbow", (0, 0, 0), 0.284838, (0.0012536, 0.0012536, 0.0000556)),
    "forearm": ("fore_roll", (0, 0, 0), 2.809107, (0.0320219, 0.0320219, 0.0033805)),
    "wrist": ("forearm", (0.321, 0, 0), 0.016755, (0.0000045, 0.0000045, 0.0000008)),
    "hand": ("wrist", (0, 0, 0), 2.144661, (0.0054903, 0.0054903, 0.0054903)),
}
JOINTS = {  # body, axis, range, damping, gear
    "shoulder_pan": ("shoulder", (0, 0, 1), (-2.2854, 1.714602), 2.0, 20),
    "shoulder_lift": ("lift", (0, 1, 0), (-0.5236, 1.3963), 2.0, 10),
    "upper_arm_roll": ("upper_roll", (1, 0, 0), (-1.5, 1.7), 0.8, 10),
    "elbow_flex": ("elbow", (0, 1, 0), (-2.3213, 0.0), 0.8, 10),
    "forearm_roll": ("fore_roll", (1, 0, 0), (-1.5, 1.5), 0.8, 10),
    "wrist_flex": ("wrist", (0, 1, 0), (-1.094, 0.0), 0.8, 10),
    "wrist_roll": ("hand", (1, 0, 0), (-1.5, 1.5), 0.8, 10),
}
RANGES = np.array([joint[2] for joint in JOINTS.values()])


def test_model_has_the_masses_joints_and_motors_of_the_published_arm(shared_env: SharedEnv) -> None:
    """The paper's code contains the published arm."""
    env = shared_env("reach")
    model = env.model
    assert (model.nq, model.nv, model.nu, model.nmocap) == (7, 7, 7, 1)
    for name, (parent, position, mass, inertia) in BODIES.items():
        body = model.body(name)
        assert model.body(body.parentid[0]).name == parent
        np.testing.assert_allclose(body.pos, position, atol=1e-12)
        np.testing.assert_allclose(body.mass, mass, rtol=1e-6, atol=5e-7, err_msg=name)
        np.testing.assert_allclose(body.inertia, inertia, rtol=1e-6, atol=6e-8, err_msg=name)
    for i, (name, (body, axis, limits, damping, gear)) in enumerate(JOINTS.items()):
        joint = model.joint(i)
        assert joint.name == name and model.body(joint.bodyid[0]).name == body and model.jnt_limited[i]
        assert np.array_equal(joint.axis, axis) and not joint.pos.any()
        np.testing.assert_allclose(joint.range, limits, rtol=1e-12)
        assert (model.dof_damping[i], model.dof_armature[i], model.dof_frictionloss[i]) == (damping, 0.004, 0)
        assert model.actuator(i).trnid[0] == i and np.array_equal(model.actuator_gear[i], [gear, 0, 0, 0, 0, 0])
        assert model.actuator_ctrllimited[i] and np.array_equal(model.actuator_ctrlrange[i], [-1, 1])
    assert model.opt.timestep == 0.01 and env.timestep == 0.02 and not model.opt.gravity.any()
    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER


def test_only_palm_and_table_collide(shared_env: SharedEnv) -> None:
    model = shared_env("reach").model
    solid = np.flatnonzero(model.geom_contype | model.geom_conaffinity)
    assert [model.body(model.geom_bodyid[i]).name for i in solid] == ["world", "hand"]
    np.testing.assert_allclose([model.geom_pos[solid[0]], model.geom_pos[solid[1]]], [[0, 0.5, -0.425], [0.03, 0, 0]])
    assert model.geom_type[solid[0]] == mujoco.mjtGeom.mjGEOM_PLANE and model.geom_size[solid[1], 0] == 0.08
    assert (model.geom_condim == 1).all() and (model.geom_margin == 0.002).all()
    assert model.site("target").size[0] == 0.05


def test_arm_moves_like_the_original_arm_for_three_seconds(shared_env: SharedEnv) -> None:
    """The controls push one joint against its limit. The expected numbers come from the original arm."""
    model = shared_env("reach").model
    data = mujoco.MjData(model)
    for i in range(300):
        data.ctrl[:] = np.sin(0.02 * i * np.arange(1, 8))
        mujoco.mj_step(model, data)
    last = [-2.28833384, -0.08709786, -1.51681723, 0.02162415, -0.11015627, -0.49795317, 1.15342769]
    np.testing.assert_allclose(data.qpos, last, atol=1e-6)


def finger(env: lw.Env, qpos: np.ndarray) -> np.ndarray:
    data, found = mujoco.MjData(env.model), []
    for row in qpos:
        data.qpos[:] = row
        mujoco.mj_kinematics(env.model, data)
        found.append(data.site("finger").xpos.copy())
    return np.array(found)


def errors(env: lw.Env, state: torch.Tensor | None = None) -> np.ndarray:
    state = env.get_state() if state is None else state
    target = env.state_space.split(state)["mocap_pos"].numpy()
    return finger(env, positions(env, state)[0]) - target


def reward(error: np.ndarray) -> np.ndarray:
    return -np.abs(error).sum(axis=1) - 5.0 * np.sqrt((error**2).sum(axis=1))


def test_reward_evaluation_and_observation_equal_the_formulas_of_lyceum(shared_env: SharedEnv) -> None:
    """Each world has a different target. States come from steps and from set_state."""
    env = shared_env("reach", nworld=NWORLD, autoreset=False)
    rng = np.random.default_rng(0)
    assert env.obs.shape == (NWORLD, 20)
    for _ in range(3):
        before = put_at_random(env, rng, position=1.0, velocity=3.0)
        env.step(torch.from_numpy(rng.uniform(-1.5, 1.5, (NWORLD, 7)).astype(np.float32)))
        qpos, qvel = positions(env)
        error = errors(env)
        assert len(np.unique(np.round(error, 6), axis=0)) == NWORLD
        check_formula(env.obs, np.concatenate([qpos, qvel, finger(env, qpos), error], axis=1))
        check_formula(env.reward, reward(error))
        check_formula(env.eval, np.linalg.norm(error, axis=1))
        assert not env.terminated.any()
    after = put_at_random(env, rng, position=1.0, velocity=3.0)
    check_formula(env.get_reward(before, torch.zeros(NWORLD, 7), after), reward(errors(env, after)))
    check_formula(env.get_eval(after), np.linalg.norm(errors(env, after), axis=1))


def targets(env: lw.Env) -> np.ndarray:
    return env.state_space.split(env.get_state())["mocap_pos"].numpy().copy()


@pytest.mark.usefixtures("freed")
@pytest.mark.parametrize("scale", [None, (0.1, 0.5, 0.0)])
def test_random_resets_place_the_target_within_its_box(scale: tuple[float, float, float] | None) -> None:
    """Each world has another random target. The arm starts at rest with all joints at zero."""
    env = lw.make("reach", engine="mujoco", nworld=2000, **({} if scale is None else {"target_range": scale}))
    env.rand_reset(0)
    size = np.array(scale or (0.3, 0.2, 0.25))
    found = targets(env)
    assert not found[:, size == 0].any()
    check_uniform(found[:, size > 0] / size[size > 0].astype(np.float32))
    qpos, qvel = positions(env)
    assert not qpos.any() and not qvel.any()
    check_formula(env.eval, np.linalg.norm(errors(env), axis=1))
    env.reset()
    np.testing.assert_allclose(targets(env), np.full((2000, 3), 0.1), atol=1e-7)


@pytest.mark.usefixtures("freed")
def test_random_start_places_every_joint_within_its_range() -> None:
    env = lw.make("reach", engine="mujoco", nworld=2000, random_start=True)
    qpos, qvel = positions(env)
    assert not qvel.any()
    low, high = RANGES.T.astype(np.float32).astype(np.float64)
    middle = np.concatenate([(2.0 * qpos - low - high) / (high - low), targets(env) / (0.3, 0.2, 0.25)], axis=1)
    check_uniform(middle / (1.0 + 1e-6))
    for _ in range(20):
        env.step(torch.zeros(2000, 7))
    assert not env.done.any()


def put_targets(env: lw.Env, distance: np.ndarray) -> None:
    state = env.get_state()
    parts = env.state_space.split(state)
    hand = finger(env, parts["qpos"].numpy())
    parts["mocap_pos"].copy_(torch.from_numpy(hand + np.stack([distance, 0 * distance, 0 * distance], axis=1)))
    env.set_state(state)


def test_task_succeeds_after_ten_steps_at_the_target() -> None:
    """Success takes ten steps even with a larger success distance. The count of steps is part of the state, and a reset
    clears it."""
    env = lw.make("reach", engine="mujoco", nworld=3, success_distance=np.array([0.05, 0.05, 0.99]), horizon=0)
    put_targets(env, np.array([0.0, 0.06, 0.0]))
    still = torch.zeros(3, 7)
    assert not env.success.any()
    for _ in range(9):
        env.step(still)
        assert not env.success.any()
    env.step(still)
    assert env.success.tolist() == [True, False, True]
    assert env.eval.tolist() == pytest.approx([0.0, 0.06, 0.0], abs=1e-6)
    state = env.get_state()
    env.rand_reset(mask=torch.tensor([True, False, False]))
    assert env.success.tolist() == [False, False, True]
    env.reset()
    assert not env.success.any()
    env.set_state(state)
    assert env.success.tolist() == [True, False, True]


def test_success_depends_on_the_mean_of_the_last_ten_distances(shared_env: SharedEnv) -> None:
    """The targets jump every six steps."""
    env = shared_env("reach", nworld=64, autoreset=False, horizon=0)
    rng = np.random.default_rng(0)
    distances: list[np.ndarray] = []
    successes = 0
    for i in range(60):
        if i % 6 == 0:
            put_targets(env, rng.uniform(0.0, 0.1, 64))
        env.step(torch.from_numpy(rng.uniform(-0.1, 0.1, (64, 7)).astype(np.float32)))
        distances.append(np.linalg.norm(errors(env), axis=1))
        mean = np.mean(distances[-10:], axis=0) if i >= 9 else np.full(64, np.inf)
        clear = np.abs(mean - 0.05) > 1e-6
        assert np.array_equal(env.success.numpy()[clear], mean[clear] < 0.05)
        successes += int(env.success.sum())
    assert 300 < successes < 51 * 64 - 300
