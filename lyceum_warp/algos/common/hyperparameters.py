"""Define hyperparameters that several algorithms have, and their bounds."""

import dataclasses
import math
from typing import Literal, TypeAlias

from lyceum_warp.support.validate import Rule

Activation: TypeAlias = Literal["tanh", "relu", "leaky_relu", "elu", "selu", "gelu", "silu", "softplus"]
"""The name of an activation function of a network."""

PICTURE_RULES: dict[str, Rule] = {"frames": 2, "random_shift": 0}
"""Bounds of ``PictureConfig``."""

GROUP = "the name of a group of observations"
"""What the name of a group must be."""

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
