"""One word for one thing: words and phrases that were settled against, with their replacements."""

from pathlib import Path

ROOT = Path(__file__).parent.parent

SETTLED: dict[str, str] = {
    r"\b(has|have|had) to be\b": "must be",
    r"\b(has|have) to (?!be\b)": "must",
    r"\bmend(s|ed|ing)?\b": "fix",
    r"\btells? (of|how|which|what|whether|about)\b": "says, reports, holds, shows",
    r"\bis told\b": "gets, is given",
    r"\b[Ww]hoever\b": "the caller, or a passive",
    r"\bfor who\b": "for a caller that",
    r"\b(nobody|somebody|everybody|someone|everyone's)\b": "the caller, no code, a passive",
    r"\b(it|that|this) is none\b": "it is not a ...",
    r"\bis no (number|tensor|table|trajectory|action|task|run|mocap|function|copy)\b": "is not a ...",
    r"\bas if (the|it|a) .* never\b": "both runs produce identical numbers",
    r"\bcomes? to light\b": "is found, before ...",
    r"\bsame mood\b": "under the same load",
    r"\ba no is no\b": "a negative answer costs nothing",
    r"\bgoodbye\b": "the end of the program",
    r"\bfor ever\b": "forever, without end",
    r"\bgo(es)? round\b": "are repeated",
    r"\bgone into\b": "followed",
    r"\bwhat came of it\b": "the result",
    r"\bslip of the pen\b": "misspelt",
    r"\b(film|films|filmed|filming)\b": "video",
    r"\brecordings?\b": "graph (captured launches), episode, buffer or video",
    r"\brecordable\b": "capturable",
    r"\bunrecorded\b": "without graphs",
    r"\brecords?\b(?! of the versions)": "graph, buffer, episode, row or video",
    r"\brecorded\b": "captured (a graph), kept (a buffer), saved (an episode)",
    r"\b(in )?trouble\b": "fault",
    r"\babsurd\b(?! \(beyond)": "beyond 1e10",
    r"\ba (cell|value|name|state) is none\b": "is not a ...",
    r"\bsenseless\b": "meaningless",
    r"\bkeep the peace\b": "agree",
    r"\bof one's own\b": "of your own",
    r"\bby itself\b": "automatically, alone",
    r"\bby themselves\b": "automatically, alone",
    r"\bmakes? no sense\b": "is out of range, does not fit",
}
"""Regular expressions of phrases, with what to write instead."""
