"""Damage files and command lines at random.

A damaged input must either work or cause a documented error. A failure prints the case and the command that repeats it.
"""

import functools
from collections.abc import Collection
from typing import Any

import command_attacks
import file_attacks
import pytest
from guarded import Outcome, attacks, replay
from minimal_cases import COMMANDS, FILES

PROGRAMS: dict[str, tuple[Collection[str], int, Collection[str]]] = {
    "file_attacks.py": (file_attacks.KINDS, 150, FILES),
    "command_attacks.py": (command_attacks.SMALL, 50, COMMANDS),
}
"""The kinds of random cases of each attack program, how many cases of each kind it runs, and its minimal cases."""


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Return ``outcomes(program, random)``, which runs all random cases or all minimal cases of a program."""

    @functools.cache
    def run(program: str, random: bool) -> dict[str, Outcome]:
        kinds, count, minimal = PROGRAMS[program]
        cases = [f"{kind} {seed}" for kind in kinds for seed in range(count)]
        return attacks(program, cases if random else [*minimal], tmp_path_factory.mktemp("fuzz"))

    return run


@pytest.mark.long
@pytest.mark.parametrize(("program", "kind"), [(name, kind) for name in PROGRAMS for kind in PROGRAMS[name][0]])
def test_random_cases_work_or_raise_a_one_line_error(outcomes: Any, program: str, kind: str) -> None:
    found = {case: o for case, o in outcomes(program, True).items() if case.rpartition(" ")[0] == kind}
    assert len(found) == PROGRAMS[program][1]
    bad = [f"{o.problem}\n    {replay(program, case)}\n{o.trace}" for case, o in found.items() if o.problem]
    assert not bad, "\n".join([f"{len(bad)} of {len(found)} cases", *bad])


@pytest.mark.quick("file_attacks.py")
@pytest.mark.parametrize(("program", "name"), [(name, case) for name in PROGRAMS for case in PROGRAMS[name][2]])
def test_minimal_case_raises_a_documented_error(outcomes: Any, program: str, name: str) -> None:
    outcome = outcomes(program, False)[name]
    assert not outcome.problem, f"{outcome.problem}\n    {replay(program, name)}\n{outcome.trace}"
