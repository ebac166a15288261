"""Check tensors and policies that users pass."""

from collections.abc import Callable
from typing import Any

import torch

from lyceum_warp.support.validate import described


def check_tensor(value: Any, name: str, like: torch.Tensor) -> None:
    """Check that a value has the shape, the type and the device of a buffer."""
    if not isinstance(value, torch.Tensor) or value.shape != like.shape or value.dtype != like.dtype:
        raise ValueError(f"{name} must be {described(like)}, not {described(value)}")
    if value.device != like.device:
        raise ValueError(f"{name} must be on {like.device}, not on {value.device}: move it with .to()")


def memoryless_action(act: Callable[[torch.Tensor], Any], obs: torch.Tensor) -> Any:
    """Call a policy, and check that its actions do not depend on earlier calls.

    Memory would leak from one episode into the next. Policies may draw from torch's global random generators.

    Raises:
        ValueError: After a call with other observations, the policy gives other actions for the same observations.
    """
    with torch.random.fork_rng([obs.device] if obs.is_cuda else []):
        first = act(obs)
        first = first.clone() if isinstance(first, torch.Tensor) else None  # a policy may return a buffer
        act(obs + 0.1)
    action = act(obs)
    if first is not None and not torch.equal(first.nan_to_num(), action.nan_to_num()):
        raise ValueError(
            "the policy gives different actions for the same observations: it has memory, which no reset clears, or a "
            "random generator of its own, and must have neither"
        )
    return action
