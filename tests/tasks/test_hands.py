"""Compare the LEAP hand's tasks with MuJoCo Playground's formulas, computed anew from MuJoCo's own quantities."""

import functools
import itertools
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from conftest import SharedEnv

import lyceum_warp as lw
from lyceum_warp.tasks.hands import gates
from lyceum_warp.testing import check_task
from lyceum_warp.testing.fault_rules import check_bad_state

QUIET = {
    "joint_position_noise": 0.0, "object_position_noise": 0.0, "object_rotation_noise": 0.0, "goal_angle": [0.1, 0.1],
}  # fmt: skip


def quat(function: object, *values: np.ndarray, size: int = 4) -> np.ndarray:
    out = np.zeros(size)
    function(out, *values)  # type: ignore[operator]
    return out


def turned(q: np.ndarray, goal: np.ndarray) -> np.ndarray:
    return quat(mujoco.mju_mulQuat, q, quat(mujoco.mju_negQuat, goal))


def angle(q: np.ndarray, goal: np.ndarray) -> float:
    return float(2.0 * np.arcsin(min(1.0, np.linalg.norm(turned(q, goal)[1:]))))


def linear(x: float, high: float, margin: float) -> float:
    return max(0.0, 1.0 - 0.9 * max(0.0, x - high) / margin)


def part(env: lw.Env, state: torch.Tensor, name: str) -> np.ndarray:
    return env.state_space.split(state)[name][0].double().numpy()


@pytest.fixture
def played(shared_env: SharedEnv) -> tuple[lw.Env, list[tuple[torch.Tensor, torch.Tensor, torch.Tensor]]]:
    """A few random steps: the states before and after each, and the action."""
    env = shared_env("leap_reorient", **QUIET)
    steps, generator = [], torch.Generator().manual_seed(3)
    for _ in range(12):
        before = env.get_state()
        env.step(1.5 * torch.randn(env.action.shape, generator=generator))
        steps.append((before, env.action.clone(), env.get_state()))
    return env, steps


def test_reorientation_rewards_equal_playgrounds_formulas(
    played: tuple[lw.Env, list[tuple[torch.Tensor, torch.Tensor, torch.Tensor]]],
) -> None:
    env, steps = played
    params, palm = env.task.params, env.model.site("grasp_site").pos
    for before, action, after in steps:
        env.set_state(before)
        env.step(action)
        q0, q1, goal = part(env, before, "qpos"), part(env, after, "qpos"), part(env, before, "mocap_quat").reshape(4)
        a = action[0].double().numpy()
        last, previous = part(env, before, "last_action"), part(env, before, "previous_action")
        expected = {
            "aligned": 0.1 * linear(angle(q1[19:], goal), 0.2, np.pi),
            "progress": (angle(q0[19:], goal) - angle(q1[19:], goal)) / params["dt"],
            "centred": 0.05 * linear(float(np.linalg.norm(q1[16:19] - palm)), 0.02, 0.05),
            "pose_l2": -0.05 * float(np.square(q1[:16] - params["default_pose"]).sum()),
            "action_rate": -1e-4 * float(np.square(a - last).sum() + np.square(a - 2.0 * last + previous).sum()),
            "excess_l2": -0.1 * float(np.square(np.maximum(np.abs(a) - 1.0, 0.0)).sum()),
        }
        for name, value in expected.items():
            assert env.metrics[name].item() == pytest.approx(params["dt"] * value, abs=2e-5), name
        power = (env.field("qvel")[0, :16] * env.field("qfrc_actuator")[0, :16]).abs().sum().item()
        assert env.metrics["absolute_power"].item() == pytest.approx(-1e-4 * params["dt"] * power, abs=1e-6)


def test_reorientation_observes_the_object_relative_to_the_goal(
    played: tuple[lw.Env, list[tuple[torch.Tensor, torch.Tensor, torch.Tensor]]],
) -> None:
    env, steps = played
    state = steps[-1][2]
    env.set_state(state)
    qpos, goal = part(env, state, "qpos"), part(env, state, "mocap_quat").reshape(4)
    axes = quat(mujoco.mju_quat2Mat, turned(qpos[19:], goal), size=9)[3:]
    for group in ("policy", "critic"):
        parts = env.obs_spaces[group].split(env.obs_groups[group])
        assert np.allclose(parts["joint_position"][0], qpos[:16], atol=1e-6)
        assert np.allclose(parts["target_error"][0], qpos[:16] - part(env, state, "target"), atol=1e-6)
        assert np.allclose(parts["object_position"][0], qpos[16:19] - env.model.site("grasp_site").pos, atol=1e-6)
        assert np.allclose(parts["object_axes"][0], axes, atol=1e-5)
        assert np.allclose(parts["last_action"][0], steps[-1][1][0].clamp(-1.0, 1.0), atol=1e-6)


def test_targets_move_by_clipped_actions_and_keep_their_range(shared_env: SharedEnv) -> None:
    env = shared_env("leap_reorient", **QUIET)
    target = part(env, env.get_state(), "target")
    low, high = env.model.actuator_ctrlrange.T
    for action in (3.0, 0.5, -9.0, 1.0):
        env.step(torch.full_like(env.action, action))
        target = np.clip(target + 0.5 * np.clip(action, -1.0, 1.0), low, high)
        assert np.allclose(env.field("ctrl")[0], target, atol=1e-6)
        assert np.allclose(part(env, env.get_state(), "target"), target, atol=1e-6)


def test_goal_turns_after_a_success_and_then_comes_to_rest(shared_env: SharedEnv) -> None:
    env = shared_env("leap_reorient", **QUIET)

    def step(goal: np.ndarray | None = None) -> np.ndarray:
        """Make a step with the object in the air, and return the goal after it."""
        state = env.get_state()
        parts = env.state_space.split(state)
        parts["qpos"][0, 16:] = torch.tensor([0.1, 0.0, 0.4, 1.0, 0.0, 0.0, 0.0])
        parts["qvel"][:] = 0.0
        if goal is not None:
            parts["mocap_quat"][0] = torch.tensor(goal)
        env.set_state(state)
        env.step(torch.zeros_like(env.action))
        return part(env, env.get_state(), "mocap_quat").reshape(4)

    aside, here = np.array([0.0, 1.0, 0.0, 0.0]), np.array([1.0, 0.0, 0.0, 0.0])
    assert np.array_equal(step(aside), aside) and env.metrics["success"].item() == 0.0
    goals = [here, step(here)]
    assert env.metrics["success"].item() == 1.0 and env.metrics["goals"].item() == pytest.approx(10.0)
    spin = part(env, env.get_state(), "goal_spin").ravel()
    assert ((spin >= 1.0) & (spin <= 5.0)).all()
    for _ in range(12):
        goals.append(step())
        assert env.metrics["success"].item() == 0.0
    steps = np.array([angle(b, a) for a, b in itertools.pairwise(goals)])
    assert np.isclose(0.1 * np.linalg.norm(spin), steps[0], rtol=1e-3)
    assert np.allclose(steps[1:] / steps[:-1], 0.8, atol=0.01)


def test_rotation_rewards_the_vertical_spin_and_ends_when_the_object_is_lost(shared_env: SharedEnv) -> None:
    env = shared_env("leap_rotate")
    state = env.get_state()
    parts = env.state_space.split(state)
    parts["qpos"][0, 16:] = torch.tensor([0.1, 0.0, 0.4, 1.0, 0.0, 0.0, 0.0])  # in the air
    parts["qvel"][0, 16:] = torch.tensor([0.0, 0.0, 0.0, 0.0, 0.0, 2.0])
    env.set_state(state)
    env.step(torch.zeros_like(env.action))
    assert env.eval.item() == pytest.approx(2.0, abs=1e-4)
    assert env.reward.item() == pytest.approx(2.0 * 0.05, abs=1e-4)
    for height in (-0.06, 0.7):
        parts["qpos"][0, 18] = height
        env.set_state(state)
        env.step(torch.zeros_like(env.action))
        assert env.terminated.item() and env.metrics["drop"].item() == pytest.approx(-5.0)


def test_worlds_differ_in_friction_gains_and_mass(shared_env: SharedEnv) -> None:
    env = shared_env("leap_rotate", nworld=8)
    tips = [env.model.geom(f"{finger}_tip").id for finger in ("if", "mf", "rf", "th")]
    friction = env.field("geom_friction")[:, tips, 0]
    assert ((friction >= 0.5) & (friction <= 1.0)).all() and friction[:, 0].unique().numel() == 8
    assert (friction == friction[:, :1]).all()
    mass = env.field("body_mass")[:, env.model.body("cube").id] / 0.108
    assert ((mass > 0.79) & (mass < 1.21)).all() and mass.unique().numel() == 8
    gain, bias = env.field("actuator_gainprm")[:, :, 0], env.field("actuator_biasprm")[:, :, 1]
    assert torch.allclose(gain, -bias) and ((gain > 2.39) & (gain < 3.61)).all()


def test_gate_counts_goals_and_drops(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, number in {"WORLDS": 2, "STEPS": 20, "PART": 5}.items():
        monkeypatch.setattr(gates, name, number)

    def numbers(**params: Any) -> dict[str, float]:
        gate = gates.Turns("success", "goals", least=1.0, drops=1.0, **params)
        worlds = functools.partial(lw.make, "leap_reorient", engine="mujoco", horizon=0)
        first, last = gate.measure(lambda n, **own: worlds(nworld=n, **own), lambda obs: torch.zeros(len(obs), 16))
        return first | last

    # every orientation counts as the goal, or every height as a drop
    assert numbers(goal_angle=[3.2, 3.2]) == {"first": 5.0, "success": 20.0, "drops": 0.0}
    dropped = numbers(goal_angle=[1e-6, 1e-6], drop_height=1.0)
    assert dropped["success"] == 0.0 and dropped["drops"] == pytest.approx(3600.0 / 0.05)


def test_hand_holds_other_objects(shared_env: SharedEnv) -> None:
    names = ["apple", "cubemedium", "hammer"]
    env = shared_env("leap_objects", nworld=3, objects=names, fields=("ximat",), **QUIET)
    for _ in range(10):
        env.step(torch.zeros_like(env.action))
    assert not env.terminated.any() and sum(env.fault_counts.values()) == 0
    sides = env.obs[:, env.obs_space.parts["object_sides"]].unflatten(1, (3, 3))
    apple, cube, hammer = sides.norm(dim=2)
    assert torch.allclose(cube, torch.tensor(0.065), atol=1e-4)
    assert apple.max() < 1.2 * apple.min() and hammer.max() > 3.0 * hammer.min()
    axes = env.field("ximat")[:, env.model.body("cube").id].reshape(3, 3, 3).mT
    assert torch.allclose(sides, axes * sides.norm(dim=2, keepdim=True), atol=1e-5)


def test_world_recovers_from_nan_among_many_contacts() -> None:
    check_task("leap_rotate", engine="warp", steps=50, checks=(check_bad_state,))
