"""Find out what a function would launch and allocate, without launching anything."""

import contextlib
import threading
import weakref
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import warp as wp

_ALLOCATING = ("empty", "zeros", "ones", "full", "clone", "empty_like", "zeros_like", "full_like")
_LIBRARY = ("radix_sort_pairs", "segmented_sort_pairs", "array_scan")


class Rehearsal:
    """What a function needs: the modules of its kernels, and memory while it runs."""

    def __init__(self) -> None:
        self.modules: dict[tuple[Any, int | None], None] = {}
        """Modules and block sizes (None where the launch names none), in the order of the launches."""
        self.peak = 0
        """Bytes that arrays of the function took at once, those that it returned or kept included."""
        self._now = 0

    def _note(self, kernel: Any, block_dim: int | None) -> None:
        if not kernel.is_generic:  # those are made for types of arguments, when they come
            self.modules[kernel.module, block_dim] = None

    def _count(self, array: Any) -> Any:
        size = getattr(array, "capacity", 0) if getattr(array, "ptr", None) else 0
        if size:
            self._now += size
            self.peak = max(self.peak, self._now)
            weakref.finalize(array, self._release, size)
        return array

    def _release(self, size: int) -> None:
        self._now -= size


@contextlib.contextmanager
def rehearse() -> Iterator[Rehearsal]:
    """Launches of this thread are noted instead of made; branches and loops that depend on them are gone into once.

    Sorting and scanning, whose inputs would be senseless, are left out. Copies and allocations do happen, so that what
    is called may spoil the arrays that it works on.
    """
    rehearsal, thread = Rehearsal(), threading.get_ident()
    originals = {name: getattr(wp, name) for name in ("launch", "launch_tiled", "capture_while", "capture_if")}
    allocating = {name: getattr(wp, name) for name in _ALLOCATING}

    library = {name: getattr(wp.utils, name) for name in _LIBRARY}

    def mine(name: str, instead: Callable[..., Any]) -> Callable[..., Any]:
        original = (originals | allocating)[name]

        def call(*args: Any, **kwargs: Any) -> Any:
            return (instead if threading.get_ident() == thread else original)(*args, **kwargs)

        return call

    def left_out(original: Callable[..., Any]) -> Callable[..., Any]:
        return lambda *args, **kwargs: None if threading.get_ident() == thread else original(*args, **kwargs)

    def launch(kernel: Any, dim: Any = None, *args: Any, block_dim: int | None = None, **kwargs: Any) -> None:
        if np.prod(dim):  # of a launch without threads Warp doesn't load the kernel either
            rehearsal._note(kernel, block_dim)

    def loop(condition: Any, while_body: Any, stream: Any = None, **kwargs: Any) -> None:
        while_body(**kwargs)

    def branch(condition: Any, on_true: Any = None, on_false: Any = None, stream: Any = None, **kwargs: Any) -> None:
        for body in (on_true, on_false):
            if callable(body):
                body(**kwargs)

    instead = {"launch": launch, "launch_tiled": launch, "capture_while": loop, "capture_if": branch}
    try:
        for name, function in instead.items():
            setattr(wp, name, mine(name, function))
        for name, original in allocating.items():
            counted = lambda *args, _make=original, **kwargs: rehearsal._count(_make(*args, **kwargs))  # noqa: E731
            setattr(wp, name, mine(name, counted))
        for name, original in library.items():
            setattr(wp.utils, name, left_out(original))
        yield rehearsal
    finally:
        for name, original in library.items():
            setattr(wp.utils, name, original)
        for name, original in (originals | allocating).items():
            setattr(wp, name, original)
