"""Write the tables of functions in terms.md from lyceum_warp.terms: python docs/terms_table.py."""

import ast
import inspect
import re
from pathlib import Path

from lyceum_warp import terms
from lyceum_warp.binding import overloads

PAGE = Path(__file__).resolve().parent / "terms.md"
PLACE = re.compile(r"(<!-- functions -->\n).*?(<!-- end -->)", re.DOTALL)


def cell(text: str) -> str:
    """Format a docstring as a table cell."""
    return re.sub(r"``(.+?)``", r"`\1`", " ".join(text.split())).replace("|", "\\|")


def functions() -> list[str]:
    """Make a table for each module, with a row for each function in source order."""
    lines = []
    for path in sorted(Path(terms.__file__).parent.glob("[!_]*.py")):
        tree = ast.parse(path.read_text())
        lines += [f"### {path.stem}", "", cell((ast.get_docstring(tree) or "").split("\n\n")[0]), ""]
        lines += ["| function | value |", "|---|---|"]
        for name in dict.fromkeys(node.name for node in tree.body if isinstance(node, ast.FunctionDef)):
            function = getattr(terms, name)
            text, _, _ = inspect.getdoc(function).partition("\n\nArgs:")
            signatures = dict.fromkeys(f"`{name}({', '.join(each.input_types)})`" for each in overloads(function))
            lines.append(f"| {'<br>'.join(signatures)} | {cell(text)} |")
        lines.append("")
    return lines[:-1]


def written(page: str) -> str:
    """Return the page with up-to-date tables."""
    return PLACE.sub(lambda match: "\n".join([match[1], *functions(), "", match[2]]), page)


if __name__ == "__main__":
    PAGE.write_text(written(PAGE.read_text()))
