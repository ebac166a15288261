"""Batched MuJoCo worlds for robot learning: one task source, two engines, arrays shared with torch.

Importing the package loads neither torch nor Warp nor MuJoCo. Each public name loads its module at first use (PEP 562).
"""

import ast
import importlib
from pathlib import Path
from typing import Any

__version__ = "0.2.0"

_MODULES = {
    alias.name: node.module
    for node in ast.parse(Path(__file__).with_suffix(".pyi").read_text("utf-8")).body
    if isinstance(node, ast.ImportFrom) and node.module
    for alias in node.names
}
__all__ = sorted(_MODULES)


def __getattr__(name: str) -> Any:
    if name in ("terms", "walkers"):  # users write lw.terms.NAME, not lw.NAME
        return importlib.import_module(f"{__name__}.{name}")
    if (module := _MODULES.get(name)) is None:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(module), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, "terms", "walkers"})
