"""List minimal cases of failures, and the classes of known failures, which the fuzzers ignore.

The last part of a case is the class of its failure, or "" if it is fixed. A class without cases is no longer ignored.
"""

import io
import json
import re
import struct
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

CLASSES = {
    "R4": ("damaged weights are accepted", r"\.pt, .* other weights than those that were saved were accepted"),
    "R7 config": ("a bad value in config.json is a traceback", r"config\.json, [\w ]+: (?!SystemExit)\w+ at "),
    "R7 versions": ("a versions.json that is not a table is a traceback", r"^versions\.json, [\w ]+: \w+ at "),
    "R7 metrics": (
        "a damaged metrics.csv is noticed after the training, or is a traceback",
        r"^metrics\.csv, resume: (refused, but it changed|the message does not name|Error at)",
    ),
    "R7 policy": ("a bad value in a policy or a checkpoint is a traceback", r"\.pt, [\w ]+: \w+ at "),
    "R7 memory": ("a policy of huge sizes takes memory before it is refused", r"\.pt, .* takes too much memory"),
    "R7 episode": ("a bad value in a saved episode is a traceback", r"^episode\.npz, [\w ]+: \w+ at "),
    "F1": (
        "a bad value in config.json is refused without the file's name",
        r"config\.json, .*(the message does not name the file|SystemExit)",
    ),
    "F2": ("a bad value in a policy is refused without the file's name", r"\.pt, [\w ]+: the message does not name"),
    "F3": ("a bad value in a saved episode is refused without the file's name", r"^episode\.npz, .* does not name the"),
    "F4": (
        "networks of sizes that memory cannot hold are refused by torch",
        r"^(GaussianPolicy|ValueFunction|NPG)\(.*(RuntimeError at (networks|value)\.py|too much memory)",
    ),
    "R8 fields": ("fields and dynamics that are tensors are a traceback", r"\b(fields|dynamics)=.* at options\.py"),
    "R8 physics": ("physics of another type with options is a traceback", r"physics=.* at options\.py"),
    "R8 iterations": ("iterations of 1e9 are a traceback", r"^(MPPI|CEM)\(.*iterations=.* at mppi\.py"),
    "N8": ("evaluate passes on torch's error about a policy of other sizes", r"^evaluate\(.*policy="),
}
"""The description of a class of failures, and the pattern of its messages."""


def _json(**changes: Any) -> Callable[[bytes], bytes]:
    return lambda data: json.dumps({**json.loads(data), **changes}).encode()


def _saved(change: Callable[[dict[str, Any]], Any]) -> Callable[[bytes], bytes]:
    """Change the content of a file of torch."""

    def changed(data: bytes) -> bytes:
        content = torch.load(io.BytesIO(data), weights_only=True)
        file = io.BytesIO()
        torch.save(change(content) or content, file)
        return file.getvalue()

    return changed


def _top(**changes: Any) -> Callable[[bytes], bytes]:
    return _saved(lambda content: content.update(changes))


def _policy(**changes: Any) -> Callable[[bytes], bytes]:
    return _saved(lambda content: content["policy"].update(changes))


def _shape(**sizes: Any) -> Callable[[bytes], bytes]:
    return _saved(lambda content: content["policy"]["shape"].update(sizes))


def _weight(data: bytes) -> bytes:
    """Flip a bit of a weight within the file."""
    weights = torch.load(io.BytesIO(data), weights_only=True)["policy"]["state"]["network.0.weight"].flatten()
    found = data.index(struct.pack("<3f", *weights[:3].tolist()))
    return data[: found + 2] + bytes([data[found + 2] ^ 0x40]) + data[found + 3 :]


def _info(**changes: Any) -> Callable[[bytes], bytes]:
    """Change the description of a saved episode."""

    def changed(data: bytes) -> bytes:
        with np.load(io.BytesIO(data)) as file:
            arrays = dict(file)
        arrays["info"] = np.array(json.dumps({**json.loads(str(arrays["info"])), **changes}))
        new = io.BytesIO()
        np.savez(new, **arrays)
        return new.getvalue()

    return changed


def _header(data: bytes) -> bytes:
    """Put a shape of 40 GB into a table's header."""
    return data.replace(b"(40, 2), }        ", b"(9999999999,), }  ")


Change = Callable[[bytes], bytes]
_SOURCE = {"task": "point_mass", "options": {"engine": "x"}}

FILES: dict[str, tuple[str, str, Change, str]] = {
    "config.json whose task is a number": ("config.json", "eval", _json(task=3), "R7 config"),
    "config.json without params": ("config.json", "eval", _json(params=None), ""),
    "config.json nested too deep": ("config.json", "open", lambda data: b"[" * 100_000, "R7 config"),
    "a kept file that is a number": ("kept config.json", "eval kept", _json(kept={"file": 3, "name": ""}), "R7 config"),
    "config.json whose algorithm is a list": ("config.json", "resume", _json(algorithm=[1]), ""),
    "versions.json that is a list": ("versions.json", "eval", lambda data: b"[]", "R7 versions"),
    "metrics.csv with a word": ("metrics.csv", "resume", lambda data: data.replace(b"\n1,", b"\none,"), "R7 metrics"),
    "metrics.csv that is not UTF-8": ("metrics.csv", "resume", lambda data: data + b"\xff", "R7 metrics"),
    "policy.pt with a flipped bit of a weight": ("policy.pt", "load", _weight, "R4"),
    "policy.pt whose shape is a text": ("policy.pt", "load", _policy(shape="x"), "R7 policy"),
    "policy.pt of sizes of 10^9": ("policy.pt", "load", _shape(nobs=10**9), "R7 memory"),
    "policy.pt with widths that are a number": ("policy.pt", "load", _shape(hidden=3), "F2"),
    "best.pt without the value of its score": ("best.pt", "resume", _top(score={}), "R7 policy"),
    "checkpoint.pt whose iteration is a list": ("checkpoint.pt", "resume alone", _top(iteration=[1]), "R7 policy"),
    "checkpoint.pt whose policy is a list": ("checkpoint.pt", "resume alone", _top(policy=[]), ""),
    "config.json of another device": ("config.json", "eval", _json(device="x"), "F1"),
    "config.json with a seed of 2^63": ("config.json", "from", _json(seed=2**63), ""),
    "an episode with numbers in state_parts": ("episode.npz", "episodes", _info(state_parts={"x": 3}), "R7 episode"),
    "an episode of an unknown engine": ("episode.npz", "episodes", _info(source=_SOURCE), "F3"),
    "a table whose header asks for 40 GB": ("table.npy", "table", _header, ""),
    "a table whose header does not end": ("table.npy", "table", lambda data: data.replace(b"}", b"(", 1), ""),
}
"""A file of a kind, a reader and a change; the file must be refused, or read if the change does not matter."""

KEYWORDS: dict[str, tuple[str, dict[str, Any], str]] = {
    "fields that are a tensor": ("make", {"fields": torch.tensor(3)}, "R8 fields"),
    "physics that is a number of NumPy": ("make", {"physics": np.float32(2), "cone": "elliptic"}, "R8 physics"),
    "iterations of 1e9": ("MPPI", {"iterations": 1e9}, "R8 iterations"),
    "a policy of other sizes": ("evaluate", {"policy": torch.nn.Linear(3, 2)}, "N8"),
    "a policy of 2^31 actions": ("GaussianPolicy", {"nact": 2**31 - 1}, "F4"),
    "a policy that is not a function": ("evaluate", {"policy": 3}, ""),
    "an environment that is a text": ("control_async", {"env": "hopper"}, ""),
    "a time feature of 10^9 powers": ("ValueFunction", {"time_orders": 10**9}, "F4"),
    "10^9 plants": ("CEM", {"plants": 10**9}, ""),
    "a horizon of 10^9 steps": ("OpenLoop", {"horizon": 10**9}, ""),
    "a period of 2^63 seconds": ("control_async", {"period": 2**63}, ""),
    "a run that is a list": ("load", {"run": []}, ""),
}
"""A call and arguments that it must refuse by their names or values."""

COMMANDS: dict[str, tuple[tuple[str, ...], str]] = {
    "a negative number of steps": (("check", "point_mass", "--steps", "-5"), ""),
    "a folder with markup": (
        (*"train point_mass --out [/bold]x --iterations 1 --samples 8 --nworld 2 --horizon 4".split(), "--no-video"),
        "",
    ),
}
"""Command lines that must end with a line."""


def open_classes() -> list[re.Pattern[str]]:
    """The patterns of the classes that still have a case."""
    known = {case[-1] for cases in (FILES, KEYWORDS, COMMANDS) for case in cases.values()} - {""}
    return [re.compile(CLASSES[name][1]) for name in known]
