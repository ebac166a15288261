"""Access and patch internals of Warp and MuJoCo Warp.

Only this module uses such internals, so a new version of these packages cannot break any other module.
"""

import contextlib
import functools
import importlib
import threading
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import warp as wp


def builtin_functions() -> Mapping[str, Any]:
    """Return Warp's built-in functions by name; some, such as ``wp.tid``, are not attributes of ``warp``."""
    functions: Mapping[str, Any] = wp._src.context.builtin_functions
    return functions


def extend_structs() -> None:
    """Let a Python class extend a ``wp.struct`` and inherit its fields, as in ``class World(go1.World)``.

    Warp refuses a class that extends a struct, because a struct is not a type. If the class extended the struct's
    Python class instead, Warp would lose the inherited fields, because it reads only the annotations of the class
    itself.
    """
    codegen: Any = wp._src.codegen

    def merge(cls: Any, /, **keywords: Any) -> None:
        if not issubclass(cls, codegen.StructInstance):  # skip Warp's own instance class
            inherited: dict[str, Any] = {}
            for base in reversed(cls.__mro__[1:]):
                inherited |= vars(base).get("__annotations__", {})
            cls.__annotations__ = inherited | vars(cls).get("__annotations__", {})

    def bases(struct: Any, given: tuple[Any, ...]) -> tuple[type, ...]:
        struct.cls.__init_subclass__ = classmethod(merge)
        return (struct.cls,)

    codegen.Struct.__mro_entries__ = bases


def is_compiled(module: Any, block: int, device: wp.Device) -> bool:
    """Whether a module of kernels, compiled for a block size, is loaded or in Warp's cache.

    If Warp's internals have changed, the result is always False, which costs time but changes no results.
    """
    if (device.context, block) in module.execs:
        return True
    try:
        module.get_module_hash(block)
        folder = Path(wp.config.kernel_cache_dir or "", module.get_module_identifier(block))
        return (folder / module._get_compile_output_name(device, block_dim=block)).is_file()
    except AttributeError:
        return False


# MuJoCo Warp is imported on demand, because the C engine does not need it


def forward_functions() -> Mapping[str, Any]:
    """Return the namespace of MuJoCo Warp's forward pass and step: functions and imported modules by name."""
    return vars(importlib.import_module("mujoco_warp._src.forward"))


def has_sdf_functions() -> bool:
    """Whether MuJoCo Warp has a registered distance function for SDF plugins; its default function raises an error."""
    collision_sdf = importlib.import_module("mujoco_warp._src.collision_sdf")
    return bool(collision_sdf.user_sdf.func.__module__ != collision_sdf.__name__)


class _PerThread(threading.local):
    """A thread-local attribute of Warp's runtime, initially None."""

    value: Any = None

    def __get__(self, runtime: object, owner: type) -> Any:
        return self.value

    def __set__(self, runtime: object, value: Any) -> None:
        self.value = value


def separate_captures() -> None:
    """Make captures of CPU launches thread-local.

    Warp's native library captures only launches of the thread that started the capture, but Warp's Python code applies
    the capture to all threads. Captured loops of other threads would become part of the graph, and launches of other
    threads would overwrite the graph's arguments.
    """
    for name in ("_apic_capture", "_apic_graph"):
        setattr(wp._src.context.Runtime, name, _PerThread())


class _Tiles(threading.local):
    """Thread-local flag that is set when a kernel with tiles was launched."""

    launched = False


tiles = _Tiles()
TILES_ON_CPU = threading.RLock()
"""The lock that is held while kernels with tiles run on the CPU. Kernels that are compiled for x86 store the address of
their tiles in a static variable, so two threads would overwrite each other's tiles."""


def separate_tiles() -> None:
    """Serialise CPU launches of kernels that use tiles, and set ``tiles.launched`` at each such launch."""
    launch_tiled = wp.launch_tiled

    def launch(*args: Any, **options: Any) -> Any:
        tiles.launched = True
        on_cpu = wp.get_device(options.get("device")).is_cpu
        with TILES_ON_CPU if on_cpu else contextlib.nullcontext():
            return launch_tiled(*args, **options)

    wp.launch_tiled = launch


@contextlib.contextmanager
def replaced_in_this_thread(functions: Mapping[str, Callable[..., Any]]) -> Iterator[None]:
    """Replace functions of Warp for calls from this thread.

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


_REMADE = ("reset_data", "get_state", "set_state")
"""The functions of MuJoCo Warp that define their kernels again in every call. Each kernel is a closure over one
variable, the mask, and depends only on whether the mask is None."""


def quicken_mujoco_warp() -> None:
    """Cache results in MuJoCo Warp's host code; without graphs, this code takes most of the time of a step or a reset.

    For each pair of geom types, MuJoCo Warp calls a Warp function from Python, and each call resolves overloads. The
    functions in ``_REMADE`` parse and hash their kernels in every call, and ``put_model`` parses packages' metadata.
    """
    convex: Any = importlib.import_module("mujoco_warp._src.collision_convex")
    primitive: Any = importlib.import_module("mujoco_warp._src.collision_primitive")
    for module in (convex, primitive):
        module.upper_trid_index = module.upper_trid_index.func  # no kernel of these modules calls the replaced function
    packages: Any = importlib.import_module("mujoco_warp._src.util_pkg")
    packages.check_version = functools.cache(packages.check_version)
    make, made = wp.kernel, {}

    @functools.wraps(make)
    def kernel(f: Any = None, **options: Any) -> Any:
        return make(f, **options) if f or options.get("module") != "unique" else lambda f: unique(f, options)

    def unique(f: Any, options: Mapping[str, Any]) -> wp.Kernel:
        if f.__qualname__.partition(".")[0] not in _REMADE or not f.__module__.startswith("mujoco_warp."):
            return make(**options)(f)
        key = f.__code__, f.__closure__[0].cell_contents is None
        if key not in made:
            made[key] = make(**options)(f)
        return made[key]

    wp.kernel = kernel
