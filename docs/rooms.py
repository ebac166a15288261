"""Write the map of modules in architecture.md from the docstrings of modules: python docs/rooms.py."""

import ast
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "architecture.md"
PLACE = re.compile(r"(<!-- rooms -->\n).*?(<!-- end -->)", re.DOTALL)


def job(path: Path) -> str:
    """Get the first line of a module's docstring, without its full stop."""
    text = ast.get_docstring(ast.parse(path.read_text())) or ""
    return re.sub(r"``(.+?)``", r"`\1`", text.split("\n\n")[0].replace("\n", " ")).removesuffix(".").replace("|", "\\|")


def rows(folder: Path, prefix: str = "") -> list[str]:
    """Return a row for each module in a folder, and for each subfolder. All tasks share a row."""
    found = []
    for path in sorted(folder.iterdir(), key=lambda path: (path.is_dir(), path.name)):
        if path.is_dir() and (path / "__init__.py").exists():
            found.append(f"| **`{prefix}{path.name}/`** | {job(path / '__init__.py')} |")
            found += [] if path.name == "tasks" else rows(path, f"{prefix}{path.name}/")
        elif path.suffix == ".py" and not path.name.startswith("__"):
            found.append(f"| `{prefix}{path.name}` | {job(path)} |")
    return found


def written(page: str) -> str:
    """Return the page with an up-to-date map."""
    table = "\n".join(["| module | job |", "|---|---|", *rows(ROOT / "lyceum_warp")])
    return PLACE.sub(lambda found: f"{found[1]}\n{table}\n\n{found[2]}", page)


if __name__ == "__main__":
    PAGE.write_text(written(PAGE.read_text()))
