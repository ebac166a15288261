"""Check that the fields of a configuration match their annotations and bounds, and define fields that several have."""

import dataclasses
import math
import types
import typing
from collections.abc import Mapping
from typing import Any, Literal, TypeAlias

from lyceum_warp.support.validate import check_flag, check_kind, check_word, finite_number, layer_sizes, whole_number

Activation: TypeAlias = Literal["tanh", "relu", "leaky_relu", "elu", "selu", "gelu", "silu", "softplus"]
"""The name of an activation function of a network."""

Bound: TypeAlias = float | tuple[float, float]
"""The minimum of a number, or its minimum and its maximum."""

PICTURE_BOUNDS: dict[str, Bound] = {"frames": 2, "random_shift": 0}
"""Bounds of ``PictureConfig``."""

LEAST = -math.inf
"""Lower bound that admits every finite number."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class PictureConfig:
    """Hyperparameters of policies that see cameras."""

    policy_groups: tuple[str, ...] = ()
    """Groups of observations for the policy; by default "policy" and all cameras. ("camera",) hides the numbers of the
    group "policy" from the policy."""
    channels: tuple[int, ...] = (16, 32, 32)
    """Channels of the convolutional layers that encode a picture. Each layer halves its width and height."""
    spatial_softmax: bool = False
    """Whether the features of a picture are the mean positions of the last layer's channels (Levine et al. 2016,
    "End-to-End Training of Deep Visuomotor Policies"). Otherwise, a linear layer computes them."""
    frames: int = 3
    """Number of a world's last pictures that the policy sees: the features of the current picture, and their changes
    since earlier ones. The policy's state holds the features. With ``recurrent``, a GRU replaces them."""
    random_shift: int = 0
    """Largest random shift of the pictures in an update, in pixels (Yarats et al. 2021, "Image Augmentation Is All You
    Need"). Each world has one shift in each iteration."""


def check_fields(config: Any, bounds: Mapping[str, Bound]) -> None:
    """Check the fields of a frozen dataclass, and convert numbers to their annotated types.

    The function checks numbers with bounds, bools, ``Literal``, widths of hidden layers (``tuple[int, ...]``) and names
    of observation groups (``str | None``).

    Raises:
        ValueError: A value is of the wrong type, out of range or not finite.
    """
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        kinds = (field.type, *typing.get_args(field.type))
        if value is not None or types.NoneType not in kinds:
            object.__setattr__(config, field.name, _checked(field.name, value, kinds, bounds.get(field.name)))


def _checked(name: str, value: Any, kinds: tuple[Any, ...], bound: Bound | None) -> Any:
    if bound is not None:
        low, high = bound if isinstance(bound, tuple) else (bound, math.inf)
        if int in kinds:
            return whole_number(name, value, low=int(low), high=int(min(high, 2**31 - 1)))
        return finite_number(name, value, low=low, high=high)
    if tuple[int, ...] in kinds:
        return tuple(layer_sizes(value, name))
    if tuple[str, ...] in kinds:
        if not isinstance(value, list | tuple) or not all(isinstance(word, str) for word in value):
            raise ValueError(f"{name} must be names of groups of observations, as in ('camera',), not {value!r}")
        return tuple(value)
    if bool in kinds:
        check_flag(name, value)
    if kinds[0] == str | None:
        check_kind(name, value, str, "the name of a group of observations")
    words = [word for kind in kinds if typing.get_origin(kind) is Literal for word in typing.get_args(kind)]
    if words and not isinstance(value, tuple(kind for kind in kinds if isinstance(kind, type))):
        check_word(name, value, words)
    return value
