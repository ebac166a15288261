"""Reach what Warp and MuJoCo Warp do not export: no other file may, so that a new version is checked here alone."""

import importlib
from collections.abc import Mapping
from typing import Any

import warp as wp


def builtin_functions() -> Mapping[str, Any]:
    """Warp's built-in functions by name; ``wp.tid`` and others are not attributes of ``warp``."""
    functions: Mapping[str, Any] = wp._src.context.builtin_functions
    return functions


def has_sdf_functions() -> bool:
    """Whether a distance function of SDF plugins was registered with MuJoCo Warp, whose own one only fails."""
    # the C engine does without MuJoCo Warp: the module is loaded where it is used
    collision_sdf = importlib.import_module("mujoco_warp._src.collision_sdf")
    return bool(collision_sdf.user_sdf.func.__module__ != collision_sdf.__name__)
