"""List the experiments, by the first lines of their docstrings."""

import ast
from pathlib import Path


def main() -> None:
    for path in sorted(Path(__file__).parent.glob("*.py")):
        module = ast.parse(path.read_text())
        names = [target.id for each in module.body if isinstance(each, ast.Assign) for target in each.targets
                 if isinstance(target, ast.Name)]  # fmt: skip
        if "EXPERIMENT" in names:
            print(f"{path.stem:<13} {(ast.get_docstring(module) or '').splitlines()[0]}")
    print("\nlyceum-warp bench NAME --help     # list the options of an experiment or of another program in bench/")
    print("lyceum-warp bench compare OLD     # compare this working tree with a revision, bit for bit")
    print("lyceum-warp bench plot [NAME]     # draw figures of stored results: bench/results/NAME-MACHINE.png")
    print("lyceum-warp bench tables [NAME]   # write tables of stored results: bench/results/NAME.md")


if __name__ == "__main__":
    main()
