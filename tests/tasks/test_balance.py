import numpy as np
import pytest
import torch
from conftest import SharedEnv

import lyceum_warp as lw
from lyceum_warp.tasks.balance.humanoid_balance import JOINTS


def test_motors_act_as_servos_within_the_torque_limits_of_the_model(shared_env: SharedEnv) -> None:
    env = shared_env("humanoid_stand", nworld=2, autoreset=False, fields=["ctrl"])
    before, action = env.field("qpos").clone(), torch.zeros(2, 17)
    action[0], action[1] = 0.01, 100.0
    env.step(action)
    joint = JOINTS.index("left_hip_y")
    column, motor = env.model.joint("left_hip_y").qposadr[0], env.model.actuator("left_hip_y").id
    torque = 150.0 * (-0.3 + 1.0 * 0.01 - before[0, column])  # the model's motor has no damping
    assert env.task.params["stiffness"][joint] == 150.0 and env.model.actuator_gear[motor, 0] == 300.0
    assert env.field("ctrl")[0, motor].item() == pytest.approx(torque.item() / 300.0, rel=1e-4)
    assert env.field("ctrl")[1, motor].item() == pytest.approx(0.4)


def test_push_changes_the_momentum_by_its_impulse_at_the_given_time() -> None:
    options = {"nworld": 16, "autoreset": False, "seed": 3}
    pushed, free = (lw.make("humanoid_stand", push_times=[time], **options) for time in (0.03, 9.0))
    for env in (pushed, free):
        env.rand_reset(3)
        env.step()
    assert torch.equal(pushed.field("qvel"), free.field("qvel"))
    for env in (pushed, free):
        env.step()
    change = (pushed.field("qvel") - free.field("qvel")).double()
    mass = pushed.model.body_subtreemass[0]
    impulse = mass * change[:, :2].norm(dim=1)
    assert 10.0 <= impulse.min() < 13.0 and 17.0 < impulse.max() <= 20.0 and not change[:, 2:].any()
    directions = torch.atan2(change[:, 1], change[:, 0])
    assert directions.min() < -1.0 and directions.max() > 1.0


def test_capture_metric_is_the_distance_between_capture_point_and_feet(shared_env: SharedEnv) -> None:
    env = shared_env("humanoid_stand", nworld=2, autoreset=False, fields=["qvel"])
    env.reset()
    state = env.get_state()
    state[1, env.state_space.parts["qvel"].start] = 1.0  # forward, m/s
    env.set_state(state)
    env.step(torch.zeros(2, 17))
    metric = env.metrics["capture_l2"] / (-20.0 * env.timestep)  # m^2
    height = env.field("subtree_com")[0, 0, 2].item()
    still, moving = metric.sqrt().tolist()
    assert moving - still == pytest.approx(np.sqrt(height / 9.81), rel=0.15)


@pytest.mark.parametrize(
    ("task", "least"), [("humanoid_stand", 1.1), pytest.param("g1_stand", 0.65, marks=pytest.mark.long)]
)
def test_robot_stands_with_a_planner_and_falls_without_one(shared_env: SharedEnv, task: str, least: float) -> None:
    env = shared_env(task, autoreset=False)
    plan = lw.MPPI(task, samples=16, nthread=1)
    assert plan.timestep == env.timestep and plan.env.options.physics.timestep > env.model.opt.timestep
    planned = lw.control(env, plan, seed=0, steps=120)
    fallen = lw.control(env, lambda state, obs: torch.zeros(env.action_space.size), seed=0, steps=120)
    height = planned.states[:, planned.state_parts["qpos"][0] + 2]
    assert planned.steps == 120 and height.min() > least
    assert fallen.steps < 120


def test_g1_walk_lifts_the_feet_in_turn_without_actions(shared_env: SharedEnv) -> None:
    env = shared_env("g1_walk", autoreset=False, fields=["ctrl"])
    env.reset()
    knees = []
    for _ in range(40):  # a cycle of 0.8 s
        env.step(torch.zeros(1, 12))
        knees.append(env.field("ctrl")[0, [3, 9]] - 0.669)
    left, right = torch.stack(knees).T
    assert left.max() > 0.59 and right.max() > 0.59 and torch.minimum(left, right).abs().max() < 1e-6


def test_humanoid_get_up_starts_lying_without_terminating(shared_env: SharedEnv) -> None:
    env = shared_env("humanoid_get_up", nworld=16, autoreset=False)
    qpos = env.field("qpos")
    assert (qpos[:, 2] < 0.4).all()
    # height of the torso's x axis, which points up if the robot lies on its back
    forward = 2.0 * (qpos[:, 4] * qpos[:, 6] - qpos[:, 3] * qpos[:, 5])
    assert forward.max() > 0.7 and forward.min() < -0.7
    for _ in range(5):
        env.step(torch.zeros(16, 17))
    assert not env.terminated.any() and not env.success.any()
