"""Translate Warp's compile errors into one line that names the function, the line and the fix."""

import re
from pathlib import Path

from lyceum_warp.binding.bound_task import BoundTask
from lyceum_warp.core.fields import is_data_field
from lyceum_warp.core.model_fields import is_model_field
from lyceum_warp.core.task import FUNCTIONS
from lyceum_warp.support.suggestions import did_you_mean
from lyceum_warp.support.upstream import builtin_functions

_NUMBERS = "write numbers as floats, as in 2.0, and convert integers by float(n)"

_FIXES = (
    (r"tuple_t", "a function returns one number, not a tuple"),
    (r"overload for '(?:quat\w*|mul)' .*\bvec4f\b",
     "quaternions are w, x, y, z here: use lw.quat_rotate, lw.quat_mul, ... in place of Warp's functions"),
    (r"\]\s*(?:\*|/|//|%|\*\*)=.*overload for 'extract'",
     "Warp has no such assignment to an element of a row: write a[i] = a[i] * x in place of a[i] *= x"),
    (r"overload for 'pow' .*int32", "write the exponent as a float, as in x ** 2.0"),
    (r"overload for '(max|min)' .*\[\w+(?:, \w+){2,}\]", "it takes two arguments, as in wp.{0}(a, wp.{0}(b, c))"),
    (r"overload for '\w+' .*\bint32\b", _NUMBERS),
    (r"types must be the same|same scalar type|annotated as `float` but .* `int32`", _NUMBERS),
    (r"annotated as `float` but .* `bool`", "write wp.where(condition, 1.0, 0.0)"),
    (r"([\w.]*\b(\w+))\(.*overload for '\2'", "help({0}) lists the types of its arguments"),
    (r"call `address\(\)` instead of `view\(\)`", "an index must be an integer, as in row[int(x)]"),
    (r"external reference type: <class '(?:numpy\.ndarray|list|tuple|dict)'>",
     "move the values into Params, as in table: wp.array[float] = [0.1, 0.2]"),
    (r"maximum recursion depth", "a function cannot call itself: use a loop"),
    (r"find function (?:np|numpy|math)\.", "use Warp's functions, such as wp.sin, wp.clamp and wp.length"),
)  # fmt: skip
"""Patterns of a source line with Warp's message, each with the fix. Groups of a pattern replace {0}."""


def explained(error: Exception, task: BoundTask) -> Exception:
    """Shorten an error to one line if Warp could not compile the functions of a task."""
    text = str(error.args[0]) if isinstance(error, KeyError) else str(error)
    # Warp's message starts with the kernel that Warp compiled first, which may belong to another task. The error is in
    # the last function that it names. If this is a kernel, a result has the wrong type.
    *_, innermost = text.split("Error while parsing function ")
    match = re.match(r'"(\w+)" at (.*?):(\d+):\n(.*?)\n;(.*)', innermost, re.DOTALL)
    if not match:
        from_warp = type(error).__module__.startswith("warp")
        return ValueError(f"Warp can't compile it: {' '.join(text.split())}") if from_warp else error
    function, file, line, source, message = (" ".join(group.split()) for group in match.groups())
    call = re.search(r"\b(reward|evaluate|terminated|success)\((?:s0|s1|view)\b", source)
    kind = re.search(r"value argument type \((.+?)\) must be|with different type \(<class '[\w.]*?(\w+)'>\)", message)
    if call and kind:
        name, returned = call.group(1), kind.group(1) or kind.group(2)
        return ValueError(f"{name} returns {returned}: it must be written as {FUNCTIONS[name].signature}")
    hint = _hint(f"{source} {message}", task)
    return ValueError(
        f"Warp can't compile {function} ({Path(file).name}, line {line}): '{source}': {message.rstrip('.')}"
        f"{hint and f': {hint}'}"
    )


def _hint(text: str, task: BoundTask) -> str:
    if missing := re.search(r"`(\w+)` is not an attribute of '\w+' \(.*?(\w+)\)", text):
        name, struct = missing.groups()
        if struct == "World" and (is_data_field(name) or is_model_field(name)):
            return f"add {task.declaration(name)} to World"
        structs = {"World": task.source.world, "Params": task.source.params}
        hint = did_you_mean(name, structs[struct].vars) if struct in structs else ""
        return hint or (f"add {name}: float = 1.0 to Params" if struct == "Params" else f"{struct} has no such field")
    if unknown := re.search(r"find function (?:wp|warp)\.(\w+)", text):
        return did_you_mean(unknown.group(1), builtin_functions())
    matches = ((re.search(pattern, text), fix) for pattern, fix in _FIXES)
    return next((fix.format(*match.groups()) for match, fix in matches if match), "")
