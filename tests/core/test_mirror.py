from typing import Any

import mujoco
import pytest
import torch
from conftest import SharedEnv

import lyceum_warp as lw
from lyceum_warp.algos.common.symmetry import Reflected, reflections
from lyceum_warp.tasks.humanoid import Humanoid

PARTS = {"gravity": slice(0, 3), "foot_height": slice(3, 5)}


def test_mirror_combines_the_reflections_of_several_parts() -> None:
    mirror = lw.Mirror({"gravity": (1, -1, 1), "foot_height": ([1, 0], [1, 1]), "other": (-1,)})
    assert mirror.columns(PARTS, task="walker") == ([0, 1, 2, 4, 3], [1.0, -1.0, 1.0, 1.0, 1.0])
    whole = lw.Mirror({"action": ([1, 0], [-1, -1])})
    motors = {"left": slice(0, 1), "right": slice(1, 2)}
    assert whole.columns(motors, task="walker", whole="action") == ([1, 0], [-1.0, -1.0])


@pytest.mark.parametrize("part", [(1, 2), ([0, 2], [1, 1]), ([1, 2, 0], [1, 1, 1]), ([1, 0], [1, -1])])
def test_reflections_that_are_not_their_own_inverse_raise_an_error(part: tuple[object, ...]) -> None:
    with pytest.raises(ValueError, match=r"the reflection 'x' of lw.Mirror must be its own inverse"):
        lw.Mirror({"x": part})


def test_error_of_a_missing_reflection_names_the_part() -> None:
    with pytest.raises(ValueError, match="'walker' has no reflection for 'foot_height', which has 2 columns"):
        lw.Mirror({"gravity": (1, -1, 1)}).columns(PARTS, task="walker")
    with pytest.raises(ValueError, match="has a reflection of 2 columns for 'gravity', which has 3"):
        lw.Mirror({"gravity": (1, -1)}).columns(PARTS, task="walker")


class SymmetricHumanoid(Humanoid):
    """Gymnasium's humanoid, except that the joints of the right leg have the constants of the left leg."""

    @staticmethod
    def edit_model(spec: mujoco.MjSpec) -> None:
        spec.joint("right_hip_y").armature = spec.joint("left_hip_y").armature
        spec.joint("right_knee").stiffness = spec.joint("left_knee").stiffness


@pytest.mark.parametrize("task", ["ant", SymmetricHumanoid])
def test_mirror_image_of_a_robot_moves_like_the_robot(task: Any, shared_env: SharedEnv) -> None:
    env = shared_env(task, nworld=8, exclude_current_positions_from_observation=False, autoreset=False)
    mirror = {name: Reflected(found) for name, found in reflections(env).items()}
    low, high = torch.as_tensor(env.action_space.low), torch.as_tensor(env.action_space.high)
    actions = low + (high - low) * torch.rand(31, *env.action.shape, generator=torch.Generator().manual_seed(0))
    for action in actions[:30]:  # until limbs touch the floor
        env.step(action)
    assert (env.obs[:, env.obs_space.parts["contact_force"]] != 0.0).any()
    state, parts = env.get_state(), env.state_space.parts
    image = env.obs_space.split(mirror["obs"](env.obs))
    env.step(actions[30])
    obs, reward = env.obs.clone(), env.reward.clone()
    for name, source in {"qpos": "position", "qvel": "velocity"}.items():
        state[:, parts[name]] = image[source].double()
    env.set_state(state)
    env.step(mirror["action"](actions[30]))
    torch.testing.assert_close(env.obs, mirror["obs"](obs), atol=1e-3, rtol=1e-3)
    torch.testing.assert_close(env.reward, reward, atol=1e-3, rtol=1e-3)
    without_xy = Reflected(reflections(shared_env(task, nworld=8))["obs"])
    assert torch.equal(without_xy(obs[:, 2:]), mirror["obs"](obs)[:, 2:])
