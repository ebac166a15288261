"""Failures that are known: minimal cases for tests, and the classes that the fuzzers pass over meanwhile.

A case that is fixed loses its ``known``. When no case of a class is left, the fuzzers look for it again.
"""

import dataclasses
import io
import json
import re
import struct
from collections.abc import Callable, Mapping
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
    "R8 steps": ("check --steps -5 is a traceback", r"^lyceum-warp check .* at "),
    "N8": ("evaluate passes on torch's error about a policy of other sizes", r"^evaluate\(.*policy="),
}
"""Known failures, and the pattern of their lines, by class."""


def reason(name: str) -> str:
    """The reason for an expected failure."""
    return f"{name.split()[0]}: {CLASSES[name][0]}"


@dataclasses.dataclass(frozen=True)
class File:
    """A damaged file that must be refused, or read if it does not matter."""

    kind: str
    reader: str
    change: Callable[[bytes], bytes]
    known: str = ""


@dataclasses.dataclass(frozen=True)
class Keywords:
    """Arguments that a call must refuse by their names or values."""

    call: str
    arguments: Mapping[str, Any]
    known: str = ""


@dataclasses.dataclass(frozen=True)
class Command:
    """A command line that must end with a line."""

    words: tuple[str, ...]
    known: str = ""


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
    """Let a table's header name a shape of 40 GB."""
    old = b"(40, 2), }        "
    assert old in data
    return data.replace(old, b"(9999999999,), }  ")


FILES = {
    "config.json whose task is a number": File("config.json", "eval", _json(task=3), "R7 config"),
    "config.json whose kept is a list": File("config.json", "open", _json(kept=[]), "R7 config"),
    "config.json without params": File("config.json", "eval", _json(params=None)),
    "config.json nested too deep": File("config.json", "open", lambda data: b"[" * 100_000, "R7 config"),
    "config.json whose kept file is a number": File(
        "kept config.json", "eval kept", _json(kept={"file": 3, "name": "slide"}), "R7 config"
    ),
    "config.json whose algorithm is a list": File("config.json", "resume", _json(algorithm=[1])),
    "versions.json that is a list": File("versions.json", "eval", lambda data: b"[]", "R7 versions"),
    "metrics.csv with a word for a number": File(
        "metrics.csv", "resume", lambda data: data.replace(b"\n1,", b"\none,", 1), "R7 metrics"
    ),
    "metrics.csv that is not UTF-8": File("metrics.csv", "resume", lambda data: data + b"\xff", "R7 metrics"),
    "policy.pt with a flipped bit of a weight": File("policy.pt", "load", _weight, "R4"),
    "policy.pt whose shape is a text": File(
        "policy.pt", "load", _saved(lambda c: c["policy"].update(shape="x")), "R7 policy"
    ),
    "policy.pt whose state is a text": File(
        "policy.pt", "load", _saved(lambda c: c["policy"].update(state="x")), "R7 policy"
    ),
    "policy.pt of sizes of 10^9": File("policy.pt", "load", _shape(nobs=10**9), "R7 memory"),
    "policy.pt with widths that are a number": File("policy.pt", "load", _shape(hidden=3), "F2"),
    "best.pt without the value of its score": File(
        "best.pt", "resume", _saved(lambda c: c.update(score={})), "R7 policy"
    ),
    "checkpoint.pt whose iteration is a list": File(
        "checkpoint.pt", "resume alone", _saved(lambda c: c.update(iteration=[1])), "R7 policy"
    ),
    "checkpoint.pt whose policy is a list": File(
        "checkpoint.pt", "resume alone", _saved(lambda c: c.update(policy=[]))
    ),
    "config.json of another device": File("config.json", "eval", _json(device="x"), "F1"),
    "config.json with a text for a number": File("config.json", "resume", _json(keep_every="x"), "F1"),
    "config.json with a seed of 2^63": File("config.json", "from", _json(seed=2**63)),
    "an episode whose state_parts have numbers": File(
        "episode.npz", "episodes", _info(state_parts={"time": 3}), "R7 episode"
    ),
    "an episode whose options have another engine": File(
        "episode.npz", "episodes", _info(source={"task": "point_mass", "options": {"engine": "x"}}), "F3"
    ),
    "a table whose header asks for 40 GB": File("table.npy", "table", _header),
    "a table whose header does not end": File("table.npy", "table", lambda data: data.replace(b"}", b"(", 1)),
}  # fmt: skip

KEYWORDS = {
    "fields that are a tensor": Keywords("make", {"fields": torch.tensor(3)}, "R8 fields"),
    "physics that is a number of NumPy": Keywords("make", {"physics": np.float32(2), "cone": "elliptic"}, "R8 physics"),
    "iterations of 1e9": Keywords("MPPI", {"iterations": 1e9}, "R8 iterations"),
    "a policy of other sizes": Keywords("evaluate", {"policy": torch.nn.Linear(3, 2)}, "N8"),
    "a policy of 2^31 actions": Keywords("GaussianPolicy", {"nact": 2**31 - 1}, "F4"),
    "a policy that is not a function": Keywords("evaluate", {"policy": 3}),
    "an environment that is a text": Keywords("control_async", {"env": "hopper"}),
    "a time feature of 10^9 powers": Keywords("ValueFunction", {"time_orders": 10**9}, "F4"),
    "10^9 plants": Keywords("CEM", {"plants": 10**9}),
    "10^9 episodes": Keywords("evaluate", {"episodes": 10**9}),
    "a horizon of 10^9 steps": Keywords("OpenLoop", {"horizon": 10**9}),
    "a period of 2^63 seconds": Keywords("control_async", {"period": 2**63}),
    "a rollout of 10^9 steps": Keywords("Rollout", {"steps": 10**9}),
    "a run that is a list": Keywords("load", {"run": []}),
    "resume that is a number": Keywords("train", {"resume": 7}),
}

COMMANDS = {
    "a negative number of steps": Command(("check", "point_mass", "--steps", "-5"), "R8 steps"),
    "a folder with markup": Command(
        ("train", "point_mass", "--out", "[/bold]x", "--iterations", "1", "--samples", "8", "--nworld", "2",
         "--horizon", "4", "--no-video", "--no-plot"),
    ),
}  # fmt: skip


def open_classes() -> dict[str, re.Pattern[str]]:
    """The classes of failures that some case still has, by name."""
    known = {case.known for cases in (FILES, KEYWORDS, COMMANDS) for case in cases.values()} - {""}
    return {name: re.compile(CLASSES[name][1]) for name in known}
