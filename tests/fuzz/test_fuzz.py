"""Damage files, command lines and arguments at random; each must work or raise a documented error.

The message of a failure names the case and the command that repeats it.
"""

import functools
import shutil
from collections.abc import Mapping
from typing import Any

import pytest
from guarded import Outcome, attacks, replay
from minimal_cases import COMMANDS, FILES, KEYWORDS

FEW = {
    "file_attacks.py": {
        "config.json": 1, "kept config.json": 1, "metrics.csv": 1, "policy.pt": 1, "best.pt": 1,
        "checkpoint.pt": 1, "previous.pt": 1, "episode.npz": 1, "kept model": 1, "kept table": 1, "model.xml": 1,
        "table.npy": 1,
    },
    "keyword_attacks.py": {
        "EnvOptions": 15, "PhysicsOptions": 15, "MPPIConfig": 15, "NPGConfig": 15, "make": 4, "MPPI": 4, "CEM": 2,
        "NPG": 3, "evaluate": 3, "train": 3, "control": 3, "control_async": 2, "Rollout": 3, "OpenLoop": 3, "load": 6,
        "load_value": 6, "GaussianPolicy": 20, "ValueFunction": 20,
    },
    "command_attacks.py": {
        "tasks": 1, "new": 1, "check": 1, "train": 1, "train --resume good": 1, "train --from good": 1, "eval": 1,
        "export": 1, "plan": 1, "view": 1, "bench": 1,
    },
}  # fmt: skip
"""Number of cases of each kind, by attack program."""
_MANY = {"file_attacks.py": 150, "keyword_attacks.py": 200, "command_attacks.py": 50}
MANY = {program: dict.fromkeys(FEW[program], count) for program, count in _MANY.items()}
"""Number of cases for ``make test-all``, by attack program."""
MINIMAL: dict[str, Mapping[str, Any]] = {
    "file_attacks.py": FILES, "keyword_attacks.py": KEYWORDS, "command_attacks.py": COMMANDS,
}  # fmt: skip


def each(names: Mapping[str, Mapping[str, Any]]) -> list[tuple[str, str]]:
    """Pair each program with each of the program's names."""
    return [(program, name) for program in names for name in names[program]]


def cases(counts: Mapping[str, int], first: int) -> list[str]:
    return [f"{kind} {seed}" for kind, count in counts.items() for seed in range(first, first + count)]


@pytest.fixture(scope="module")
def outcomes(pytestconfig: pytest.Config, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Return ``outcomes(program, many)``, which runs many random cases, or a few random cases and all minimal cases.

    The folder of the cases has the same path in every run of the tests.
    """
    cache = getattr(pytestconfig, "cache", None)
    parent = cache.mkdir("fuzz") if cache else tmp_path_factory.mktemp("fuzz")

    @functools.cache
    def run(program: str, many: bool) -> dict[str, Outcome]:
        folder = parent / program.removesuffix(".py")
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        chosen = cases(MANY[program], 1000) if many else [*cases(FEW[program], 0), *MINIMAL[program]]
        return attacks(program, chosen, folder)

    return run


# command lines take longest
@pytest.mark.quick(*(f"{program}-{kind}-few" for program, kind in each(FEW) if program != "command_attacks.py"))
@pytest.mark.parametrize("many", [False, True], ids=["few", "many"])
@pytest.mark.parametrize(("program", "kind"), each(FEW))
def test_random_cases_work_or_raise_a_one_line_error(outcomes: Any, program: str, kind: str, many: bool) -> None:
    count = (MANY if many else FEW)[program][kind]
    found = {case: o for case, o in outcomes(program, many).items() if case.rpartition(" ")[0] == kind}
    assert len(found) == count
    bad = [
        f"{outcome.problem}\n    {replay(program, case)}\n{outcome.trace}"
        for case, outcome in found.items()
        if outcome.problem
    ]
    assert not bad, "\n".join([f"{len(bad)} of {count} cases", *bad])


@pytest.mark.quick("file_attacks.py", "keyword_attacks.py")
@pytest.mark.parametrize(("program", "name"), each(MINIMAL))
def test_minimal_case_raises_a_documented_error(outcomes: Any, program: str, name: str) -> None:
    outcome = outcomes(program, False)[name]
    assert not outcome.problem, f"{outcome.problem}\n    {replay(program, name)}\n{outcome.trace}"
