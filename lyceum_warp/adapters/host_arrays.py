"""Copy an environment's buffers to NumPy arrays, and actions back."""

from typing import Any

import numpy as np
import torch

from lyceum_warp.env import Env
from lyceum_warp.support.validate import described


class HostArrays:
    """Transfers actions and results between NumPy arrays and an environment's buffers.

    Args:
        env: The environment.
        copy: Whether results are copies. Otherwise results of an environment on the CPU are its live buffers, which the
            next step overwrites.
        one_world: Whether actions lack the axis of worlds, because there is one world.
    """

    def __init__(self, env: Env, *, copy: bool = True, one_world: bool = False) -> None:
        self._env, self._copy = env, copy
        # on the CPU the array shares the buffer's memory; copies to a GPU start from pinned memory
        pinned = torch.empty(env.action.shape, pin_memory=True) if env.action.is_cuda else None
        self._pinned = pinned
        actions = (env.action if pinned is None else pinned).numpy()
        self._action = actions[0] if one_world else actions

    def set_action(self, action: Any) -> None:
        """Copy actions into the environment, (nworld, nact) or (nact,), float32 or float64.

        Raises:
            ValueError: They are not a NumPy array, or have another shape or type.
        """
        if not isinstance(action, np.ndarray) or action.shape != self._action.shape or action.dtype.kind != "f":
            raise ValueError(f"actions must be a float32 array of shape {self._action.shape}, not {_described(action)}")
        np.copyto(self._action, action, casting="same_kind")
        if self._pinned is not None:
            self._env.action.copy_(self._pinned, non_blocking=True)

    def of(self, *tensors: torch.Tensor) -> list[np.ndarray]:
        """Copy tensors to NumPy arrays, with at most one wait for the device."""
        if self._pinned is None:
            return [tensor.numpy().copy() if self._copy else tensor.numpy() for tensor in tensors]
        copies = [tensor.to("cpu", non_blocking=True) for tensor in tensors]
        torch.cuda.current_stream(self._env.action.device).synchronize()
        return [copy.numpy() for copy in copies]


def _described(value: Any) -> str:
    return f"a {value.dtype} array of shape {value.shape}" if isinstance(value, np.ndarray) else described(value)
