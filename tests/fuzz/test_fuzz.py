"""Damage files, command lines and arguments at random.

A damaged input must either work or cause a documented error. A failure prints the case and the command that repeats it.
"""

import functools
import shutil
from collections.abc import Iterable, Mapping
from typing import Any

import command_attacks
import file_attacks
import keyword_attacks
import pytest
from guarded import Outcome, attacks, replay
from minimal_cases import COMMANDS, FILES, KEYWORDS

KINDS: dict[str, Iterable[str]] = {
    "file_attacks.py": file_attacks.KINDS, "keyword_attacks.py": keyword_attacks.CALLS,
    "command_attacks.py": command_attacks.SMALL,
}  # fmt: skip
"""The kinds of random cases of each attack program."""
COUNTS = {"file_attacks.py": 150, "keyword_attacks.py": 200, "command_attacks.py": 50}
"""How many cases of each kind a program runs."""
MINIMAL: dict[str, Mapping[str, Any]] = {
    "file_attacks.py": FILES, "keyword_attacks.py": KEYWORDS, "command_attacks.py": COMMANDS,
}  # fmt: skip


def each(names: Mapping[str, Iterable[str]]) -> list[tuple[str, str]]:
    return [(program, name) for program in names for name in names[program]]


@pytest.fixture(scope="module")
def outcomes(pytestconfig: pytest.Config, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Return ``outcomes(program, random)``, which runs random cases or all minimal cases.

    The cases run in a folder at a constant path.
    """
    cache = getattr(pytestconfig, "cache", None)
    parent = cache.mkdir("fuzz") if cache else tmp_path_factory.mktemp("fuzz")

    @functools.cache
    def run(program: str, random: bool) -> dict[str, Outcome]:
        folder = parent / program.removesuffix(".py")
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        cases = [f"{kind} {seed}" for kind in KINDS[program] for seed in range(COUNTS[program])]
        return attacks(program, cases if random else [*MINIMAL[program]], folder)

    return run


@pytest.mark.long
@pytest.mark.parametrize(("program", "kind"), each(KINDS))
def test_random_cases_work_or_raise_a_one_line_error(outcomes: Any, program: str, kind: str) -> None:
    found = {case: o for case, o in outcomes(program, True).items() if case.rpartition(" ")[0] == kind}
    assert len(found) == COUNTS[program]
    bad = [
        f"{outcome.problem}\n    {replay(program, case)}\n{outcome.trace}"
        for case, outcome in found.items()
        if outcome.problem
    ]
    assert not bad, "\n".join([f"{len(bad)} of {len(found)} cases", *bad])


@pytest.mark.quick("file_attacks.py", "keyword_attacks.py")
@pytest.mark.parametrize(("program", "name"), each(MINIMAL))
def test_minimal_case_raises_a_documented_error(outcomes: Any, program: str, name: str) -> None:
    outcome = outcomes(program, False)[name]
    assert not outcome.problem, f"{outcome.problem}\n    {replay(program, name)}\n{outcome.trace}"
