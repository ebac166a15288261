"""Access and patch internals of Warp and MuJoCo Warp.

No other file does either, so that a new version of them is checked here alone.
"""

import contextlib
import importlib
import threading
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import warp as wp


def builtin_functions() -> Mapping[str, Any]:
    """Warp's built-in functions by name; ``wp.tid`` and others are not attributes of ``warp``."""
    functions: Mapping[str, Any] = wp._src.context.builtin_functions
    return functions


def is_compiled(module: Any, block: int, device: wp.Device) -> bool:
    """Whether a module of kernels is loaded or in Warp's cache, for a block size.

    If Warp's internals have changed the answer is no, which costs time only.
    """
    if (device.context, block) in module.execs:
        return True
    try:
        module.get_module_hash(block)
        folder = Path(wp.config.kernel_cache_dir or "", module.get_module_identifier(block))
        return (folder / module._get_compile_output_name(device, block_dim=block)).is_file()
    except AttributeError:
        return False


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


class _Tiles(threading.local):
    """Whether this thread has launched a kernel with tiles since the flag was last cleared."""

    launched = False


tiles = _Tiles()
TILES_ON_CPU = threading.RLock()
"""Held while kernels with tiles run on the CPU. A module that Warp compiles for x86 keeps the address of its tiles in a
variable that all threads share, so that two threads in one such kernel would write each other's tiles."""


def separate_tiles() -> None:
    """Let one thread at a time launch kernels with tiles on the CPU, and note the launches in ``tiles``."""
    launch_tiled = wp.launch_tiled

    def launch(*args: Any, **options: Any) -> Any:
        tiles.launched = True
        on_cpu = wp.get_device(options.get("device")).is_cpu
        with TILES_ON_CPU if on_cpu else contextlib.nullcontext():
            return launch_tiled(*args, **options)

    wp.launch_tiled = launch


@contextlib.contextmanager
def replaced_in_this_thread(functions: Mapping[str, Callable[..., Any]]) -> Iterator[None]:
    """Replace functions of Warp for the calls of this thread.

    Args:
        functions: The new functions, by their names in ``warp`` or ``warp.utils``.
    """
    thread = threading.get_ident()
    with contextlib.ExitStack() as restored:
        for name, instead in functions.items():
            owner: Any = wp if hasattr(wp, name) else wp.utils
            original = getattr(owner, name)

            def call(*args: Any, _own: Any = instead, _original: Any = original, **options: Any) -> Any:
                return (_own if threading.get_ident() == thread else _original)(*args, **options)

            setattr(owner, name, call)
            restored.callback(setattr, owner, name, original)
        yield
