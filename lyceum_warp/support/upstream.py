"""Access and patch internals of Warp, MuJoCo Warp and torch.

No other module uses such internals.
"""

import contextlib
import functools
import importlib
import inspect
import threading
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import warp as wp

from lyceum_warp.support.docstrings import attribute_docs, listed


def builtin_functions() -> Mapping[str, Any]:
    """Return a mapping from names to Warp's built-in functions.

    Some of these functions, such as ``wp.tid``, are not attributes of ``warp``.
    """
    functions: Mapping[str, Any] = wp._src.context.builtin_functions
    return functions


def fused_adam(*tensors: Any, **options: Any) -> None:
    """Make a step of Adam by torch's fused kernel, as ``torch.optim.Adam`` calls it."""
    import torch

    torch._fused_adam_(*tensors, **options)


class _StructDoc:
    """The docstring of a struct, which lists its fields. It is read from the source when ``help()`` asks for it."""

    def __get__(self, struct: Any, owner: type) -> str | None:
        if struct is None:
            return None
        docs = dict.fromkeys(struct.vars, "") | attribute_docs(*reversed(struct.cls.__mro__[:-1]))
        return f"{inspect.cleandoc(struct.cls.__doc__ or struct.key)}\n\nFields:\n{listed(docs)}\n"

    def __set__(self, struct: Any, doc: str | None) -> None:
        """Ignore the docstring that ``wp.struct`` copies from the class."""


def extend_structs() -> None:
    """Let a class extend a ``wp.struct`` and inherit its fields, as in ``class World(go1.World)``.

    In Warp, a struct is not a type, so a class cannot extend it. A class that extends the struct's Python class would
    lose its fields, because Warp reads no inherited annotations. Structs also get docstrings for ``help()``.
    """
    codegen: Any = wp._src.codegen

    def merge(cls: Any, /, **keywords: Any) -> None:
        if not issubclass(cls, codegen.StructInstance):
            inherited: dict[str, Any] = {}
            for base in reversed(cls.__mro__[1:]):
                inherited |= vars(base).get("__annotations__", {})
            cls.__annotations__ = inherited | vars(cls).get("__annotations__", {})

    def bases(struct: Any, original_bases: tuple[Any, ...]) -> tuple[type, ...]:
        struct.cls.__init_subclass__ = classmethod(merge)
        return (struct.cls,)

    codegen.Struct.__mro_entries__ = bases
    codegen.Struct.__doc__ = _StructDoc()


def refuse_integer_divisions(prefix: str) -> None:
    """Let Warp refuse ``/`` of integers in modules whose names start with ``prefix``.

    Unlike Python, Warp drops the fraction of such a quotient.
    """
    codegen: Any = wp._src.codegen
    add_call = codegen.Adjoint.add_builtin_call

    def checked(adjoint: Any, name: str, args: Any, *rest: Any, **options: Any) -> Any:
        if name == "div" and adjoint.builder is not None and adjoint.builder.module.name.startswith(prefix):
            kinds = [codegen.strip_reference(arg.type) for arg in args]
            if all(wp.types.type_is_int(getattr(kind, "_wp_scalar_type_", kind)) for kind in kinds):
                raise ValueError(
                    f"{wp.types.type_repr(kinds[0])} / {wp.types.type_repr(kinds[1])} drops the fraction: write "
                    "1.0 / 2.0 or float(n) / 2.0, or n // 2 for a whole quotient"
                )
        return add_call(adjoint, name, args, *rest, **options)

    codegen.Adjoint.add_builtin_call = checked


def is_compiled(module: Any, block: int, device: wp.Device | None, arch: int | None = None) -> bool:
    """Return whether Warp has loaded a module for a block size, or has it in its cache.

    With ``arch``, the device is None, and the result is about any device of this CUDA architecture. If Warp's internals
    have changed, the result is always False. A wrong False only costs time.
    """
    if device is not None and (device.context, block) in module.execs:
        return True
    try:
        module.get_module_hash(block)
        folder = Path(wp.config.kernel_cache_dir or "", module.get_module_identifier(block))
        return (folder / module._get_compile_output_name(device, arch, block_dim=block)).is_file()
    except AttributeError:
        return False


def compile_module(module: Any, block: int, device: wp.Device | None, arch: int | None = None) -> None:
    """Compile a module for a block size into Warp's cache; for the arguments, see ``is_compiled``."""
    if device is not None:
        wp.force_load(device, modules=[module], block_dim=block, max_workers=0)
        return
    # wp.compile_aot_module compiles for the module's own block size only
    module.get_module_hash(block)
    module._compile(None, output_arch=arch, options=module.resolved_options[block])


# the C engine does not need MuJoCo Warp


def forward_functions() -> Mapping[str, Any]:
    """Return the functions and imported modules of MuJoCo Warp's forward pass, by name."""
    return vars(importlib.import_module("mujoco_warp._src.forward"))


def has_sdf_functions() -> bool:
    """Return whether MuJoCo Warp has a distance function for SDF plugins. The default function raises an error."""
    collision_sdf = importlib.import_module("mujoco_warp._src.collision_sdf")
    return bool(collision_sdf.user_sdf.func.__module__ != collision_sdf.__name__)


class _PerThread(threading.local):
    """A thread-local attribute of Warp's runtime."""

    value: Any = None

    def __get__(self, runtime: object, owner: type) -> Any:
        return self.value

    def __set__(self, runtime: object, value: Any) -> None:
        self.value = value


def separate_captures() -> None:
    """Make captures of CPU launches thread-local.

    Warp's native library captures only one thread, but Warp's Python code applies the capture to all threads. Other
    threads would then add their loops to the graph and overwrite its arguments.
    """
    for name in ("_apic_capture", "_apic_graph"):
        setattr(wp._src.context.Runtime, name, _PerThread())


tiles = threading.local()
"""Its attribute ``launched`` says whether this thread launched a kernel with tiles since the attribute was cleared."""
TILES_ON_CPU = threading.RLock()
"""A thread holds this lock while it launches a tiled kernel on the CPU. On x86, the address of a kernel's tiles is in a
static variable, so two threads would overwrite each other's tiles."""


def separate_tiles() -> None:
    """Serialise CPU launches of kernels with tiles, and set ``tiles.launched`` at each launch."""
    launch_tiled = wp.launch_tiled

    def launch(*args: Any, **options: Any) -> Any:
        tiles.launched = True
        on_cpu = wp.get_device(options.get("device")).is_cpu
        with TILES_ON_CPU if on_cpu else contextlib.nullcontext():
            return launch_tiled(*args, **options)

    wp.launch_tiled = launch


@contextlib.contextmanager
def replaced_in_this_thread(functions: Mapping[str, Callable[..., Any]]) -> Iterator[None]:
    """Replace Warp functions for the calling thread only."""
    thread = threading.get_ident()
    with contextlib.ExitStack() as restored:
        for name, instead in functions.items():
            owner: Any = wp if hasattr(wp, name) else wp.utils
            original = getattr(owner, name)

            def call(*args: Any, _replacement: Any = instead, _original: Any = original, **options: Any) -> Any:
                return (_replacement if threading.get_ident() == thread else _original)(*args, **options)

            setattr(owner, name, call)
            restored.callback(setattr, owner, name, original)
        yield


_REMADE = ("reset_data", "get_state", "set_state")
"""Functions of MuJoCo Warp that define their kernels again in every call. Each kernel is a closure over the mask, and
depends only on whether the mask is None."""


def quicken_mujoco_warp() -> None:
    """Make MuJoCo Warp's host code faster, mostly by caching results.

    Without graphs, this code takes most of the time of a step or reset.
    For each pair of geom types, MuJoCo Warp calls a Warp function from Python, and Warp then resolves overloads. The
    functions in ``_REMADE`` parse and hash their kernels in every call, and ``put_model`` parses metadata of packages.
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
