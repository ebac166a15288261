"""The buffers of an environment as NumPy arrays."""

from typing import Any

import numpy as np
import torch

from lyceum_warp.env import Env
from lyceum_warp.support.validate import described


class HostArrays:
    """The buffers of an environment as NumPy arrays: actions go in, results come out.

    Args:
        env: The environment.
        copy: Whether results are copies. Without, those of an environment on the CPU are its live buffers, which
            change with the next step.
        one_world: Whether actions are those of the only world, without its axis.
    """

    def __init__(self, env: Env, *, copy: bool = True, one_world: bool = False) -> None:
        self._env, self._copy = env, copy
        # an environment on the CPU shares its buffer; for another one the copy to the device starts from pinned memory
        pinned = torch.empty(env.action.shape, pin_memory=True) if env.action.is_cuda else None
        self._pinned = pinned
        actions = (env.action if pinned is None else pinned).numpy()
        self._action = actions[0] if one_world else actions

    def set_action(self, action: Any) -> None:
        """Copy actions into the environment, (nworld, nact) or (nact,), float32 or float64.

        Raises:
            ValueError: They are not a NumPy array, or one of another shape or type.
        """
        if not isinstance(action, np.ndarray) or action.shape != self._action.shape or action.dtype.kind != "f":
            raise ValueError(f"actions must be a float32 array of shape {self._action.shape}, not {_described(action)}")
        np.copyto(self._action, action, casting="same_kind")
        if self._pinned is not None:
            self._env.action.copy_(self._pinned, non_blocking=True)

    def of(self, *tensors: torch.Tensor) -> list[np.ndarray]:
        """The values of some tensors of the environment's device, after at most one wait for it."""
        if self._pinned is None:
            return [tensor.numpy().copy() if self._copy else tensor.numpy() for tensor in tensors]
        copies = [tensor.to("cpu", non_blocking=True) for tensor in tensors]
        torch.cuda.current_stream(self._env.action.device).synchronize()
        return [copy.numpy() for copy in copies]


def _described(value: Any) -> str:
    return f"a {value.dtype} array of shape {value.shape}" if isinstance(value, np.ndarray) else described(value)
