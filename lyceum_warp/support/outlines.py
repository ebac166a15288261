"""Read the fields of a dataclass from its source, because the import of its module may load torch."""

import ast
import dataclasses
import importlib.util
from pathlib import Path
from typing import Any

from lyceum_warp.support.faces import sources


def outline(package: str, name: str) -> type[Any]:
    """Return a dataclass with the fields, the defaults and the docstrings of a public dataclass, but without methods.

    Only the modules that the fields' annotations and defaults need are imported.

    Args:
        package: The room, such as "lyceum_warp.algos".
        name: A name in its ``__init__.pyi``.
    """
    module, _ = sources(package)[name]
    body = ast.parse(Path(str(getattr(importlib.util.find_spec(module), "origin", ""))).read_text("utf-8")).body
    class_def = next(node for node in body if isinstance(node, ast.ClassDef) and node.name == name)
    class_def.decorator_list, class_def.body = [], [node for node in class_def.body if isinstance(node, ast.AnnAssign)]
    used = {node.id for node in ast.walk(class_def) if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load)}
    imports = [node for node in body if isinstance(node, ast.Import | ast.ImportFrom)]
    for node in imports:
        node.names = [alias for alias in node.names if (alias.asname or alias.name) in used]
    scope: dict[str, Any] = {"__name__": module}
    exec(compile(ast.Module([*(node for node in imports if node.names), class_def], []), module, "exec"), scope)
    return dataclasses.dataclass(frozen=True, kw_only=True)(scope[name])
