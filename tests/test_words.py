"""One word for one thing: words and phrases that were settled against, with their replacements.

The search covers code, comments, messages and names (an underscore counts as a space), the documents, and the files
that build and test the package. A phrase may span two lines.
"""

import bisect
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent

SETTLED: dict[str, str] = {
    # one word for one thing
    r"\brecordings?\b": "graph (captured launches), episode, buffer or video",
    r"\brecord(er|able)\b": "Graphs, capturable",
    r"\bfilm(s|ed|ing)?\b": "video",
    r"\btrouble(s|d)?\b": "fault",
    r"\babsurd(ly)?\b(?! \(beyond)": "beyond 1e10",
    r"\bbeg[aiu]n(s|ning)? again\b": "restart",
    r"\bgoodbye\b": "the end of the program",
    r"\broll-outs?\b|\broll outs\b|\b(an?|the|each|every|bare|native) roll out\b": "rollout (verb: roll out)",
    # rules
    r"\b(has|have|had) to be\b": "must be",
    r"\b(has|have) to (?!be\b|do with\b)": "must",
    # verbs
    r"\bmend(s|ed|ing)?\b": "fix",
    r"\btells\b": "says, reports, holds, shows",
    r"\btell (of|how|which|what|whether|about)\b": "say, report, hold, show",
    r"\b(is|are|was|were|be|been) told\b(?! apart)": "gets, is given, is reported",
    r"\b(tell|tells|told) (\w+ )?apart\b": "distinguish",
    r"\bcomes? to light\b": "is found",
    r"\bgo(es)? round\b": "are repeated",
    r"\bgone into\b": "followed",
    r"\bkeeps? the peace\b": "agree",
    r"\blet(s)? \w+ have a say\b": "name the option",
    # code is not a person
    r"\bwhoever\b": "the caller, or a passive",
    r"\bfor who\b": "for a caller that",
    r"\b(caller|code|engine|function|kernel|loop|method|phase|planner|process|task|thread|world)s? who\b": "that",
    r"\b(no|some|any|every)body\b": "the caller, no code, a passive",
    r"\b(some|any)one\b(?! of)": "the caller, a passive",
    r"\beveryone's\b": "every world's",
    r"\b(has|have) (no|a) say\b": "does not count, counts",
    # negations
    r"\b(it|that|this|they|these) (is|are) (?-i:none)\b": "it is not a ...",
    r"\b(cell|value|name|state) is (?-i:none)\b": "is not a ...",
    r"\bof (?-i:none)\b(?! is)": "without values",
    r"(?<!there )\bis no (?!longer\b|more\b|less\b|fewer\b)": "is not a",
    r"\ba no is no\b": "a negative answer costs nothing",
    r"\bnothing but\b": "only",
    r"\bbut for\b": "except for",
    r"\bmakes? no sense\b": "is out of range, does not fit",
    r"\bsenseless\b": "meaningless",
    # images and riddles
    r"\bas if (the|it|a) [^.]*\bnever\b": "both runs produce identical numbers",
    r"\bsame mood\b": "under the same load",
    r"\bfor ever\b": "forever, without end",
    r"\bfor good\b": "permanently",
    r"\bas ever\b": "as usual",
    r"\bafresh\b": "again",
    r"\bon that account\b": "therefore",
    r"\bwhat (came|comes) of (it|them|this)\b": "the result",
    r"\banew\b": "again",
    r"\band (its|their) like\b": "name them, or their kind",
    r"\bslips? of the pen\b": "misspelt",
    r"\b(leaves?|left) no trace\b": "changes nothing",
    r"\bwithout a word\b": "silently",
    r"\bword to the host\b": "copy to the host, synchronisation",
    r"\bnone of (its|their) business\b": "does not read",
    r"\bone's own\b": "of your own",
    r"\bby (itself|themselves)\b": "automatically, alone",
}
"""Regular expressions of phrases, in any case, with their replacements."""

ALLOWED = (
    r"event\.record\(",  # torch's name
    r"catch_warnings\(record=True\)",  # Python's
    r'"record": list\(self\.rows\)',  # MuJoCo's: Batch.rollout(record=...)
    r'self\.control, record=\["qpos", "qvel"\]',
    r"\bRecorder\b",  # of a video, viz/video.py
    r'"record": "graphs"',  # the hint for a word of earlier releases, and its tests
    r'\("record", "did you mean graphs\?"\)',
    r'\(\{"record": False\}, "no parameter \'record\': did you mean graphs"\)',
)
"""Code that must use such a word."""

QUOTING = {
    "CHANGELOG.md": (r"`[^`]*`",),  # old names
    "CONTRIBUTING.md": (r"(?ms)^```.*?^```", r"\|[^|\n]*\|$", r'"[^"\n]*"'),  # examples of bad style
}
"""Parts of documents that quote what was settled against."""

DOCUMENTS = ("README.md", "CHANGELOG.md", "CONTRIBUTING.md", "bench/README.md")
OTHERS = ("Makefile", "pyproject.toml", ".ci/run", "CITATION.cff", "constraints.txt")
FILES = [
    *(
        path
        for folder in ("lyceum_warp", "tests", "bench", "examples")
        for path in sorted((ROOT / folder).rglob("*.py"))
    ),
    *(ROOT / name for name in (*DOCUMENTS, *OTHERS)),
    *sorted((ROOT / "docs").glob("*.md")),
    *sorted(path for path in (ROOT / ".github").rglob("*") if path.is_file()),
]
NAMES = [str(path.relative_to(ROOT)) for path in FILES if path.exists() and path != Path(__file__)]


def found_in(text: str, exempt: tuple[str, ...] = ()) -> list[str]:
    """Every phrase of a text that was settled against, as "line: 'phrase' (write ...)"."""
    for pattern in exempt:
        text = re.sub(pattern, lambda found: re.sub(r"[^\n]", " ", found.group()), text, flags=re.MULTILINE)
    starts, flat = [], ""
    for line in text.splitlines():
        starts.append(len(flat))
        flat += re.sub(r"^\s*(#:?\s+)?", "", line).replace("_", " ") + " "
    found = []
    for pattern, replacement in SETTLED.items():
        for match in re.finditer(pattern, flat, re.IGNORECASE):
            found.append((bisect.bisect_right(starts, match.start()), match.group(), replacement))
    return [f"{line}: {phrase!r} (write: {replacement})" for line, phrase, replacement in sorted(found)]


def test_no_word_is_used_that_was_settled_against() -> None:
    found = [
        f"{name}:{entry}"
        for name in NAMES
        for entry in found_in((ROOT / name).read_text(), (*ALLOWED, *QUOTING.get(name, ())))
    ]
    assert not found, "\n".join(found)


@pytest.mark.parametrize(
    "text",
    [
        "A film of a step.",
        "def test_a_film_is_kept():",
        "The number has to\n    be positive.",
        "# the message names it\n# and the mend",
        "raise ValueError('it is none')",
        "This is no tensor.",
        "Whoever calls it",
        "The kernel launches by itself.",
        "as if the step had never been",
        "The roll-out is one call.",
        "the roll out of a plan",
    ],
)
def test_a_phrase_is_found_in_code_names_and_over_two_lines(text: str) -> None:
    assert len(found_in(text)) == 1


@pytest.mark.parametrize(
    "text",
    [
        "There is no task 'hoper'.",
        "A row is no longer than its buffer.",
        "beyond what an absurd (beyond 1e10) state needs",
        "It has nothing to do with it.",
        "The fault ends the episode.",
        "A planner rolls out its samples; worlds to roll out in; one rollout.",
    ],
)
def test_a_plain_sentence_has_no_such_phrase(text: str) -> None:
    assert not found_in(text)


def test_the_line_of_a_phrase_is_named() -> None:
    assert found_in("one\ntwo\n    # it has to\n    # be three")[0].startswith("3: 'has to be' (write: must be)")
