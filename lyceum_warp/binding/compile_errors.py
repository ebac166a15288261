"""Translate Warp's compile errors into one line that names the task and the fix."""

import re

from lyceum_warp.task import FUNCTIONS


def explained(error: Exception, task: str) -> Exception:
    """Shorten an error to one line if Warp could not compile the functions of a task."""
    text = str(error)
    if "while parsing function" not in text and not type(error).__module__.startswith("warp"):
        return error
    # Warp's message names the kernel that Warp compiled first, which may belong to another task
    flat = " ".join(text.split())
    # the error is in the last function that Warp's message names; if this is a kernel, a result has the wrong type
    innermost = flat.rpartition("while parsing function")[2]
    call = re.search(r"\b(reward|evaluate|terminated|success)\((?:s0|s1|view)\b", innermost)
    kind = re.search(r"value argument type \((.+?)\) must be|with different type \(<class '[\w.]*?(\w+)'>\)", flat)
    if call and kind:
        signature, returned = FUNCTIONS[call.group(1)].signature, kind.group(1) or kind.group(2)
        return ValueError(f"{call.group(1)} of the task {task!r} returns {returned}: it must be written as {signature}")
    lines = [line.strip(" ;") for line in text.splitlines() if line.strip(" ;")]
    hint = ": a function returns one number, not a tuple" if "tuple_t" in text else ""
    if re.search(r"overload for '(quat\w*|mul)' .*\bvec4f\b", flat):
        hint = ": quaternions are w, x, y, z here: use lw.quat_rotate, lw.quat_mul, ... in place of Warp's functions"
    if "overload for 'extract'" in flat and re.search(r"\]\s*(\*|/|//|%|\*\*)=", flat):
        hint = ": Warp has no such assignment to an element of a row: write a[i] = a[i] * x in place of a[i] *= x"
    return ValueError(f"Warp can't compile the functions of the task {task!r}: {' '.join(lines[-3:])}{hint}")
