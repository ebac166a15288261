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


def repeatable(act: Callable[..., Any], obs: Any, *state: torch.Tensor) -> tuple[Any, ...]:
    """Call a policy, and check that its actions do not depend on earlier calls. Return its outputs.

    The observations are a tensor, or a tuple of tensors with pictures.

    Hidden memory would leak from one episode into the next. Policies may draw from torch's global random generators.

    Raises:
        ValueError: After a call with other observations, the policy gives other actions for the same arguments.
    """

    def outputs(obs: Any) -> tuple[Any, ...]:
        result = act(obs, *state)
        return result if isinstance(result, tuple) else (result,)

    parts = obs if isinstance(obs, tuple) else (obs,)
    others = tuple(part + (0.1 if part.is_floating_point() else 1) for part in parts)
    with torch.random.fork_rng([parts[0].device] if parts[0].is_cuda else []):
        first = outputs(obs)[0]
        first = first.clone() if isinstance(first, torch.Tensor) else None  # a policy may return a buffer
        outputs(others if isinstance(obs, tuple) else others[0])
    results = outputs(obs)
    if first is not None and not torch.equal(first.nan_to_num(), results[0].nan_to_num()):
        raise ValueError(
            "the policy gives different actions for the same observations: it must have no random generator of its "
            "own, and no memory, unless it has state_size and act(obs, state) returns the actions and the next state"
        )
    return results
