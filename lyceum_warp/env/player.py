"""Call policies in all worlds of an environment, and carry their memory."""

import copy
from collections.abc import Callable
from typing import Any, TypeAlias, TypeVar

import torch
from torch import nn

from lyceum_warp.env.env import Env
from lyceum_warp.support.tensors import repeatable
from lyceum_warp.support.validate import check_group, described

Policy: TypeAlias = nn.Module | Callable[[torch.Tensor], torch.Tensor]
"""A module with the method ``act``, or a function from observations to actions."""

Module = TypeVar("Module", bound=nn.Module)


class Player:
    """A function from observations, (nworld, nobs), to a policy's actions, (nworld, nact).

    A policy with memory has the attribute ``state_size``, and its ``act(obs, state)`` returns the actions and the next
    state. Its state is 0 when an episode begins. Each call must be followed by a step of the environment. A policy that
    sees cameras has the attribute ``groups``; its observations are a tuple, to which the player adds the pictures.

    Args:
        policy: The policy. If it is a module on another device than the environment, a copy of it acts.
        env: The environment in which the policy acts.
    """

    state: torch.Tensor
    """The policy's state after the last call, (nworld, state_size); without columns if the policy has no memory."""

    def __init__(self, policy: Policy, env: Env) -> None:
        if isinstance(policy, nn.Module):
            policy = moved(policy, env)
        self._act: Callable[..., Any] = getattr(policy, "act", policy)
        self.env, self.state_size = env, getattr(policy, "state_size", 0)
        self._groups: tuple[str, ...] = getattr(policy, "groups", ("policy",))
        for group in self._groups:
            check_group(group, env.obs_groups, env.task.name)
        self.state = torch.zeros(env.nworld, self.state_size, device=env.obs.device)

    def __call__(self, obs: torch.Tensor) -> torch.Tensor:
        """Compute the actions, and keep the next state."""
        if not self.state_size:
            action: torch.Tensor = self._act(self._inputs(obs))
            return action
        action, state = self._act(self._inputs(obs), self._state())
        self.state.copy_(state.detach())
        return action

    def first(self, obs: torch.Tensor) -> torch.Tensor:
        """Compute actions like a call, and check them.

        Raises:
            ValueError: The actions or the states have the wrong shape, or the policy hides memory in the module.
        """
        state = (self._state(),) if self.state_size else ()
        try:
            outputs = repeatable(self._act, self._inputs(obs), *state)
        except RuntimeError as error:
            sizes = f"{described(obs)}{' and pictures' * (len(self._groups) > 1)}, of the task {self.env.task.name!r}"
            raise ValueError(f"policy cannot take the observations, {sizes}: {str(error).splitlines()[0]}") from error
        expected = self.env.action, *state
        if [getattr(one, "shape", None) for one in outputs] != [one.shape for one in expected]:
            texts = [" and ".join(map(described, each)) for each in (expected, outputs)]
            raise ValueError(f"policy must return {texts[0]}, not {texts[1]}")
        if state:
            self.state.copy_(outputs[1].detach())
        action: torch.Tensor = outputs[0]
        return action

    def _inputs(self, obs: torch.Tensor) -> Any:
        """Add the pictures of the cameras that the policy sees."""
        if self._groups == ("policy",):
            return obs
        return tuple(obs if group == "policy" else self.env.obs_groups[group] for group in self._groups)

    def _state(self) -> torch.Tensor:
        return self.state.masked_fill((self.env.episode_step == 0).unsqueeze(-1), 0.0)


def moved(module: Module, env: Env) -> Module:
    """Return the module, or a copy of it, on the device of an environment's observations."""
    device = env.obs.device
    if all(parameter.device == device for parameter in module.parameters()):
        return module
    return copy.deepcopy(module).to(device)
