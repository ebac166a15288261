"""Find words and phrases that CONTRIBUTING.md excludes, and name their replacements.

The search covers code, names (an underscore counts as a space) and documents. A phrase may span two lines.
"""

import bisect
import re
from pathlib import Path

ROOT = Path(__file__).parent.parent

SETTLED: dict[str, str] = {
    # words that the glossary replaces
    r"\brecordings?\b": "graph (captured launches), episode, buffer or video",
    r"\brecord(er|able)\b": "Graphs, capturable",
    r"\bfilm(s|ed|ing)?\b": "video",
    r"\btrouble(s|d)?\b": "fault",
    r"\bbeg[aiu]n(s|ning)? again\b": "restart",
    r"\broll-outs?\b|\broll outs\b|\b(an?|the|each|every|bare|native) roll out\b": "rollout (verb: roll out)",
    # rules
    r"\b(has|have|had) to be\b": "must be",
    r"\b(has|have) to (?!be\b|do with\b)": "must",
    # verbs
    r"\btells\b": "says, reports, holds, shows",
    r"\btell (of|how|which|what|whether|about)\b": "say, report, hold, show",
    r"\b(is|are|was|were|be|been) told\b(?! apart)": "gets, is given, is reported",
    r"\b(tell|tells|told) (\w+ )?apart\b": "distinguish",
    # words that fit people, not code
    r"\bwhoever\b": "the caller, or a passive",
    r"\bfor who\b": "for a caller that",
    r"\b(caller|code|engine|function|kernel|loop|method|phase|planner|process|task|thread|world)s? who\b": "that",
    r"\b(no|some|any|every)body\b": "the caller, no code, a passive",
    r"\b(some|any)one\b(?! of)": "the caller, a passive",
    # negations
    r"\b(it|that|this|they|these) (is|are) (?-i:none)\b": "it is not a ...",
    r"\b(cell|value|name|state) is (?-i:none)\b": "is not a ...",
    r"\bof (?-i:none)\b(?! is)": "without values",
    r"(?<!there )\bis no (?!longer\b|more\b|less\b|fewer\b)": "is not a",
    r"\bnothing but\b": "only",
    r"\bbut for\b": "except for",
    r"\bmakes? no sense\b": "is out of range, does not fit",
    r"\bsenseless\b": "meaningless",
    # images and riddles
    r"\bas if (the|it|a) [^.]*\bnever\b": "both runs produce identical numbers",
    r"\bfor ever\b": "forever, without end",
    r"\bfor good\b": "permanently",
    r"\bas ever\b": "as usual",
    r"\bafresh\b": "again",
    r"\banew\b": "again",
    r"\bwithout a word\b": "silently",
    r"\bone's own\b": "of your own",
    r"\bby (itself|themselves)\b": "automatically, alone",
}

ALLOWED = (
    r"event\.record\(",  # torch's name
    r"catch_warnings\(record=True\)",  # Python's
    r'"record": list\(self\.rows\)',  # an argument of MuJoCo's Batch.rollout
    r'self\.control, record=\["qpos", "qvel"\]',
    r"\bRecorder\b",  # the class Recorder of viz/video.py
    r'"record": "graphs"',  # a hint for users of earlier releases; the next two patterns allow the tests of this hint
    r'\("record", "did you mean graphs\?"\)',
    r'\(\{"record": False\}, "no parameter \'record\': did you mean graphs"\)',
)
"""Patterns of code that may contain an excluded word, for example because torch uses it."""

QUOTING = {
    "CHANGELOG.md": (r"`[^`]*`",),  # old names
    "CONTRIBUTING.md": (r"(?ms)^```.*?^```", r"\|[^|\n]*\|$", r'"[^"\n]*"'),  # examples of bad style
}
"""Documents that quote excluded words, each with patterns that match the quotations."""

DOCUMENTS = ("README.md", "CHANGELOG.md", "CONTRIBUTING.md", "bench/README.md")
OTHERS = ("Makefile", "pyproject.toml", ".ci/run", "CITATION.cff", "constraints.txt")
FILES = [
    *(
        path
        for folder in ("lyceum_warp", "tests", "bench", "examples")
        for path in sorted((ROOT / folder).rglob("*.py"))
    ),
    *(ROOT / name for name in (*DOCUMENTS, *OTHERS)),
    *sorted(path for suffix in ("md", "py", "ipynb") for path in (ROOT / "docs").rglob(f"*.{suffix}")),
    *sorted(path for path in (ROOT / ".github").rglob("*") if path.is_file()),
]
NAMES = [str(path.relative_to(ROOT)) for path in FILES if path.exists() and path != Path(__file__)]


def found_in(text: str, exempt: tuple[str, ...] = ()) -> list[str]:
    for pattern in exempt:
        text = re.sub(pattern, lambda found: re.sub(r"[^\n]", " ", found.group()), text, flags=re.MULTILINE)
    starts, flat = [], ""
    for line in text.splitlines():
        starts.append(len(flat))
        flat += re.sub(r"^\s*(#:?\s+)?", "", line).replace("_", " ") + " "
    found, lower = [], flat.lower()
    for pattern, replacement in SETTLED.items():
        # skip the exact search if this search, which takes a tenth of the time, finds nothing
        if re.search(pattern.removeprefix(r"\b"), lower) is None:
            continue
        for match in re.finditer(pattern, flat, re.IGNORECASE):
            found.append((bisect.bisect_right(starts, match.start()), match.group(), replacement))
    return [f"{line}: {phrase!r} (write: {replacement})" for line, phrase, replacement in sorted(found)]


def test_no_excluded_word_is_used() -> None:
    found = [
        f"{name}:{entry}"
        for name in NAMES
        for entry in found_in((ROOT / name).read_text(), (*ALLOWED, *QUOTING.get(name, ())))
    ]
    assert not found, "\n".join(found)


def test_excluded_phrases_are_found_in_code_names_and_across_lines() -> None:
    for text in ("def test_a_film_is_kept():", "The number has to\n    # be positive.", "'This is no tensor.'"):
        assert len(found_in(text)) == 1
