"""List minimal inputs that once failed: files and command lines."""

import io
import json
from collections.abc import Callable
from typing import Any

import numpy as np
import torch


def _json(**changes: Any) -> Callable[[bytes], bytes]:
    return lambda data: json.dumps({**json.loads(data), **changes}).encode()


def _saved(change: Callable[[dict[str, Any]], Any]) -> Callable[[bytes], bytes]:
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


def _info(**changes: Any) -> Callable[[bytes], bytes]:
    def changed(data: bytes) -> bytes:
        with np.load(io.BytesIO(data)) as file:
            arrays = dict(file)
        arrays["info"] = np.array(json.dumps({**json.loads(str(arrays["info"])), **changes}))
        new = io.BytesIO()
        np.savez(new, **arrays)
        return new.getvalue()

    return changed


def _inside(element: bytes) -> Callable[[bytes], bytes]:
    return lambda data: data.replace(b"<worldbody>", element + b"<worldbody>", 1)


def _header(data: bytes) -> bytes:
    """Declare a shape of 40 GB in the header of an array file."""
    return data.replace(b"(40, 2), }        ", b"(9999999999,), }  ")


Change = Callable[[bytes], bytes]
_SOURCE = {"task": "point_mass", "options": {"engine": "x"}}

FILES: dict[str, tuple[str, str, Change]] = {
    "config.json whose task is a number": ("config.json", "eval", _json(task=3)),
    "config.json nested too deep": ("config.json", "open", lambda data: b"[" * 100_000),
    "config.json whose kept file is a number": ("kept config.json", "eval kept", _json(kept={"file": 3, "name": "x"})),
    "config.json whose algorithm is a list": ("config.json", "resume", _json(algorithm=[1])),
    "config.json of another device": ("config.json", "eval", _json(device="x")),
    "config.json with min_restarts of 10^30": (
        "config.json", "resume", lambda data: data.replace(b'"min_restarts": null', b'"min_restarts": 1' + 30 * b"0")
    ),
    "metrics.csv with a word for a number": ("metrics.csv", "resume", lambda data: data.replace(b"\n1,", b"\none,", 1)),
    "metrics.csv that is not UTF-8": ("metrics.csv", "resume", lambda data: data + b"\xff"),
    "policy.pt whose shape is a text": ("policy.pt", "load", _policy(shape="x")),
    "policy.pt whose state is a text": ("policy.pt", "load", _policy(state="x")),
    "policy.pt of sizes of 10^9": ("policy.pt", "load", _shape(nobs=10**9)),
    "policy.pt with widths that are a number": ("policy.pt", "load", _shape(hidden=3)),
    "best.pt without the value of its score": ("best.pt", "resume", _top(score={})),
    "best.pt with a scale that is not finite": (
        "best.pt", "from best", _saved(lambda content: content["value"]["state"].update(scale=torch.tensor(torch.nan)))
    ),
    "checkpoint.pt whose iteration is a list": ("checkpoint.pt", "resume alone", _top(iteration=[1])),
    "checkpoint.pt whose state is of another iteration": ("checkpoint.pt", "resume alone", _top(iteration=7)),
    "checkpoint.pt whose policy is a list": ("checkpoint.pt", "resume alone", _top(policy=[])),
    "checkpoint.pt whose samples are a text": (
        "checkpoint.pt", "resume alone", _saved(lambda content: content["state"].update(samples="x"))
    ),
    "an episode whose state_parts have numbers": ("episode.npz", "episodes", _info(state_parts={"time": 3})),
    "an episode whose options have another engine": ("episode.npz", "episodes", _info(source=_SOURCE)),
    "a model with a name that is not UTF-8": ("kept model", "eval kept", lambda data: data.replace(b"arm", b"\xff")),
    "a model that asks for 900 GB": ("model.xml", "make", _inside(b'<size memory="900G"/>')),
    "a task's file that raises BaseException": ("task.py", "check", lambda data: data + b"\nraise BaseException"),
    "a task's file that ends the program": ("task.py", "make file", lambda data: b"raise SystemExit(0)\n" + data),
    "a motion whose pickle calls a function": ("clip.pkl", "clips", lambda data: b"cbuiltins\nprint\n(Vx\ntR."),
    "a motion whose pickle asks for a memo of 4 GB": (
        "clip.pkl", "clips", lambda data: data[:-1] + b"r\xff\xff\xff\x7f."
    ),
    "a table whose header asks for 40 GB": ("table.npy", "table", _header),
    "a table whose header does not end": ("table.npy", "table", lambda data: data.replace(b"}", b"(", 1)),
}  # fmt: skip
"""Each case is a kind of file, a reader and a change. If the change matters, the reader must reject the file."""

COMMANDS = {
    "a negative number of steps": "check point_mass --steps -5",
    "a model whose name is not UTF-8": "new my_task --model \udcff.xml",
    "a model whose name starts like a home folder": "new my_task --model ~x.xml",
    "a task whose name starts like a home folder": "new ~x --model ~x.xml",
    "a folder with markup": "train point_mass --out [/bold]x --iterations 1 --samples 8 --nworld 2 --horizon 4",
}
"""Command lines that must not end with a traceback."""
