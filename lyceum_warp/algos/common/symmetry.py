"""Compute mirror images of observations and actions, and make policies symmetric."""

from collections.abc import Callable, Mapping
from types import SimpleNamespace
from typing import Any

import torch
from torch import nn

from lyceum_warp.core.mirror import Mirror, Reflection
from lyceum_warp.env.env import Env


class Reflected(nn.Module):
    """Computes the mirror image of rows, (..., size): ``signs * rows[..., order]``."""

    order: torch.Tensor
    signs: torch.Tensor

    def __init__(self, reflection: Reflection) -> None:
        super().__init__()
        order, signs = reflection
        self.register_buffer("order", torch.tensor(order), persistent=False)
        self.register_buffer("signs", torch.tensor(signs), persistent=False)

    def forward(self, rows: torch.Tensor) -> torch.Tensor:
        """Compute the mirror image."""
        return self.swapped(rows) * self.signs

    def swapped(self, rows: torch.Tensor) -> torch.Tensor:
        """Mirror positive numbers, such as standard deviations: reorder the columns, but keep the signs."""
        return rows.index_select(-1, self.order)


class PolicyMirror(nn.Module):
    """Computes the mirror images of a policy's observations and actions."""

    def __init__(self, reflections: Mapping[str, Reflection]) -> None:
        super().__init__()
        self.reflections = {name: tuple(map(list, reflections[name])) for name in ("obs", "action")}
        self.obs, self.action = Reflected(reflections["obs"]), Reflected(reflections["action"])

    def average(self, function: Callable[[torch.Tensor], torch.Tensor], obs: torch.Tensor) -> torch.Tensor:
        """Make the actions of a function symmetric.

        The function also acts on the mirrored observations, and these actions are mirrored back. The result is the mean
        of both actions. A mirrored observation then gives the mirrored action, bit for bit; on a GPU, only without
        gradients.
        """
        image = self.obs(obs)
        if obs.is_cuda and torch.is_grad_enabled():  # one call is faster, but may round images differently
            actions, mirrored = function(torch.cat([obs, image])).chunk(2)
        else:
            actions, mirrored = function(obs), function(image)
        return 0.5 * (actions + self.action(mirrored))


def reflections(env: Env, *, group: str = "policy") -> dict[str, Reflection]:
    """Get the reflections of a task's actions ("action") and of one of its observation groups ("obs").

    Raises:
        ValueError: The task declares no mirror, or a part of the observation or action has no mirror image.
    """
    task: Any = env.task.definition
    declared = task.mirror
    if callable(declared):
        declared = declared(env.task.model, SimpleNamespace(**env.task.params))
    if not isinstance(declared, Mirror):
        raise ValueError(
            f"the task {env.task.name!r} declares no mirror image: set mirror = lw.Mirror(...) in the task"
        )
    return {
        "obs": declared.columns(env.obs_spaces[group].parts, task=env.task.name),
        "action": declared.columns(env.action_space.parts, task=env.task.name, whole="action"),
    }


def apply_symmetry(
    symmetry: str, env: Env, policy: Any, value_group: str
) -> tuple[PolicyMirror | None, Reflected | None]:
    """Make a policy symmetric if ``symmetry`` is "exact"; otherwise, make the mirrors that a learner needs.

    Returns:
        The mirror of the policy for "loss" and "augment", and the mirror of the value function's observations for
        "augment"; otherwise None.
    """
    if symmetry == "none" or policy.mirror is not None:
        return None, None
    device = env.obs.device
    if symmetry == "exact":
        policy.use_mirror(reflections(env))
        return None, None
    images = Reflected(reflections(env, group=value_group)["obs"]).to(device) if symmetry == "augment" else None
    return PolicyMirror(reflections(env)).to(device), images
