"""Make environments raise an error in forked children, where they would wait for the parent's threads forever."""

import os
import weakref
from collections.abc import Callable
from typing import Any

_watched: "weakref.WeakKeyDictionary[Any, tuple[str, ...]]" = weakref.WeakKeyDictionary()
_references: list[object] = []


class LeftInParent:
    """Replaces an attribute that a forked child must not use."""

    def __getattr__(self, name: str) -> Any:
        raise RuntimeError(
            "this environment was made before the process was forked, and its engine's threads exist only in the "
            "parent: make it in the child, or start children with multiprocessing.get_context('spawn')"
        )


def leave_in_parent(thing: Any, *attributes: str) -> None:
    """Make an object's attributes raise RuntimeError in child processes that are forked later."""
    _watched[thing] = attributes


def call_once_gone(thing: Any, function: Callable[[], object]) -> None:
    """Call a function when an object is deleted, except in forked children and at exit."""
    weakref.finalize(thing, _call_in, os.getpid(), function).atexit = False


def _call_in(process: int, function: Callable[[], object]) -> None:
    if os.getpid() == process:
        function()


def _after_fork() -> None:
    for thing, attributes in _watched.items():
        for name in attributes:
            _references.append(getattr(thing, name))  # its destructor would wait forever
            setattr(thing, name, LeftInParent())


os.register_at_fork(after_in_child=_after_fork)
