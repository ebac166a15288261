"""Reach what Warp and MuJoCo Warp do not export: no other file may, so that a new version is checked here alone."""

import importlib
from collections.abc import Mapping
from typing import Any

import warp as wp


def builtin_functions() -> Mapping[str, Any]:
    """Warp's built-in functions by name; ``wp.tid`` and others are not attributes of ``warp``."""
    functions: Mapping[str, Any] = wp._src.context.builtin_functions
    return functions


def runtime_class() -> type:
    """The class of Warp's runtime, whose attributes say which capture on the CPU is under way."""
    runtime: type = wp._src.context.Runtime
    return runtime


# the C engine does without MuJoCo Warp: its modules are loaded when they are used


def forward_functions() -> Mapping[str, Any]:
    """MuJoCo Warp's functions of a forward pass and a step by name, and the modules that they use."""
    return vars(importlib.import_module("mujoco_warp._src.forward"))


def has_sdf_functions() -> bool:
    """Whether a distance function of SDF plugins was registered with MuJoCo Warp, whose own one only fails."""
    collision_sdf = importlib.import_module("mujoco_warp._src.collision_sdf")
    return bool(collision_sdf.user_sdf.func.__module__ != collision_sdf.__name__)
