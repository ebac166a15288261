"""Reach what Warp and MuJoCo Warp do not export: no other file may, so that a new version is checked here alone."""

import importlib
import threading
from collections.abc import Mapping
from typing import Any

import warp as wp


def builtin_functions() -> Mapping[str, Any]:
    """Warp's built-in functions by name; ``wp.tid`` and others are not attributes of ``warp``."""
    functions: Mapping[str, Any] = wp._src.context.builtin_functions
    return functions


# the C engine does without MuJoCo Warp: its modules are loaded when they are used


def forward_functions() -> Mapping[str, Any]:
    """MuJoCo Warp's functions of a forward pass and a step by name, and the modules that they use."""
    return vars(importlib.import_module("mujoco_warp._src.forward"))


def has_sdf_functions() -> bool:
    """Whether a distance function of SDF plugins was registered with MuJoCo Warp, whose own one only fails."""
    collision_sdf = importlib.import_module("mujoco_warp._src.collision_sdf")
    return bool(collision_sdf.user_sdf.func.__module__ != collision_sdf.__name__)


class _PerThread(threading.local):
    """An attribute of Warp's runtime that each thread has for itself, None at first."""

    value: Any = None

    def __get__(self, runtime: object, owner: type) -> Any:
        return self.value

    def __set__(self, runtime: object, value: Any) -> None:
        self.value = value


def separate_captures() -> None:
    """Keep a capture of launches on the CPU to the thread that began it.

    Warp's library captures launches for the thread that began a capture, but its Python code takes the capture for one
    of every thread: loops of other threads would become part of the graph, and their launches would replace the
    arguments of its own.
    """
    for name in ("_apic_capture", "_apic_graph"):
        setattr(wp._src.context.Runtime, name, _PerThread())
