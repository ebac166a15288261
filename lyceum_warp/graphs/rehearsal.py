"""Find the kernels that a function launches, without launching the kernels."""

import contextlib
import threading
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from lyceum_warp.support.upstream import replaced_in_this_thread

_lock = threading.RLock()


@contextlib.contextmanager
def rehearse() -> Iterator[dict[tuple[Any, int | None], None]]:
    """List the modules of this thread's launches instead of running the kernels; graph branches and loops run once.

    Kernels do not run, but copies and allocations do. Arrays may therefore contain garbage afterwards. Only one thread
    can do this at a time; other threads launch kernels as usual.

    Yields:
        Modules and block sizes in launch order, as the keys of a dict. A block size of None is Warp's default.
    """
    modules: dict[tuple[Any, int | None], None] = {}

    def launch(kernel: Any, dim: Any = None, *args: Any, block_dim: int | None = None, **kwargs: Any) -> None:
        # a launch of size 0 loads no module; the module of a generic kernel depends on the argument types
        if np.prod(dim) and not kernel.is_generic:
            modules[kernel.module, block_dim] = None

    functions: dict[str, Callable[..., None]] = dict.fromkeys(("launch", "launch_tiled"), launch)
    functions |= {"capture_while": _loop, "capture_if": _branch}
    # sorts and scans would read garbage
    functions |= dict.fromkeys(("radix_sort_pairs", "segmented_sort_pairs", "array_scan"), _nothing)
    with _lock, replaced_in_this_thread(functions):
        yield modules


def _loop(condition: Any, while_body: Any, stream: Any = None, **kwargs: Any) -> None:
    while_body(**kwargs)


def _branch(condition: Any, on_true: Any = None, on_false: Any = None, stream: Any = None, **kwargs: Any) -> None:
    for body in (on_true, on_false):
        if callable(body):
            body(**kwargs)


def _nothing(*args: Any, **kwargs: Any) -> None:
    pass
