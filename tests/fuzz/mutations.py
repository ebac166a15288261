"""Mutate files and values at random; the seed determines the mutation."""

import csv
import io
import json
import math
import pickle
import tomllib
import warnings
import xml.etree.ElementTree as ET
import zipfile
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import torch

NUMBERS = (
    0, 1, -1, 7, 255, 2**31 - 1, 2**31, 10**9, 10**12, 2**63, 10**30, -(10**9), 0.5, -0.0, 1e-320, 1e308, -1e308,
    math.nan, math.inf, -math.inf,
)  # fmt: skip
TEXTS = (
    "", " ", "x", "nan", "1e999", "-1", "../x", "/proc/x.py", "x.npy", "a\nb", "\0", "[/bold]x", "[red]",
    "%s{}", "\u202e\u0301", "ä" * 20, "x" * 5000, "~x", "~", "\udcff",
)  # fmt: skip
VALUES = (*NUMBERS, *TEXTS, None, True, False, [], {}, [0], [[1.5]], [None], {"x": 1}, {"": []})
"""Values of every JSON type. Most arguments accept none of them."""


class Canary:
    """An object whose pickle writes a file if it is loaded unsafely."""

    def __init__(self, file: Path) -> None:
        self.file = file

    def __reduce__(self) -> tuple[Any, ...]:
        return (eval, (f"open({str(self.file)!r}, 'w').close()",))


def mutated_bytes(data: bytes, random: Random) -> bytes:
    for _ in range(random.choice((1, 1, 1, 2, 4))):
        start = random.randrange(len(data) + 1)
        stop = start + random.randint(1, 64)
        new = random.choice((b"\0" * 9, b"\xff\xfe\xfd", b"nan", b"-1", b"9" * 40, b"1e999", random.randbytes(16)))
        flipped = bytes(byte ^ 1 << random.randrange(8) for byte in data[start : start + 1])
        data = random.choice((
            data[:start] + data[stop:], data[:stop] + data[start:], data[:start] + flipped + data[start + 1 :],
            data[:start] + new + data[start + len(new) :], data[:start] + new + data[start:], data[:start],
        ))  # fmt: skip
    return data


def mutated_value(tree: Any, random: Random, values: tuple[Any, ...] = VALUES) -> Any:
    if isinstance(tree, dict | list) and tree and random.random() < 0.8:
        entries: dict[Any, Any] = dict(tree) if isinstance(tree, dict) else dict(enumerate(tree))
        name, kind = random.choice(list(entries)), random.randrange(8)
        if kind == 0:
            del entries[name]
        elif kind == 1:
            entries[random.choice(TEXTS)] = random.choice(values)
        else:
            entries[name] = mutated_value(entries[name], random, values)
        return entries if isinstance(tree, dict) else list(entries.values())
    if isinstance(tree, torch.Tensor) and random.random() < 0.8:
        huge = torch.zeros(1).expand(10**9)  # four bytes that declare a size of 4 GB
        other = tree.to(random.choice((torch.float64, torch.bool, torch.complex64, torch.int64)))
        return random.choice((huge, other, tree.flatten()[:-1], tree[None], tree.to_sparse(), tree * math.nan))
    return [tree] if random.random() < 0.1 else random.choice(values)


def mutated_json(data: bytes, random: Random) -> bytes:
    if random.random() < 0.3:
        return mutated_bytes(data, random)
    if random.random() < 0.05:
        return random.choice((b"[" * 100_000, b'{"a":' * 50_000, b"[]", b"null", b"9" * 5000, b"\xef\xbb\xbf" + data))
    return json.dumps(mutated_value(json.loads(data), random), indent=2).encode("utf-8", "surrogatepass")


def mutated_toml(data: bytes, random: Random) -> bytes:
    if random.random() < 0.3:
        return mutated_bytes(data, random)
    tree = mutated_value(tomllib.loads(data.decode()), random)
    lines = (
        [f"{json.dumps(name)} = {_toml(entry)}" for name, entry in tree.items()]
        if isinstance(tree, dict)
        else [_toml(tree)]
    )
    return "\n".join(lines).encode("utf-8", "surrogatepass")


def _toml(value: Any) -> str:
    if isinstance(value, dict):
        return f"{{{', '.join(f'{json.dumps(name)} = {_toml(entry)}' for name, entry in value.items())}}}"
    return f"[{', '.join(map(_toml, value))}]" if isinstance(value, list) else json.dumps(value)


def mutated_csv(data: bytes, random: Random) -> bytes:
    if random.random() < 0.4:
        return mutated_bytes(data, random)
    long_cell = "1" * 200_000
    rows = mutated_value(list(csv.reader(io.StringIO(data.decode()))), random, (*NUMBERS, *TEXTS, long_cell))
    text = io.StringIO()
    rows = rows if isinstance(rows, list) else [rows]  # the mutation may replace the whole table
    csv.writer(text).writerows(row if isinstance(row, list) else [row] for row in rows)
    return text.getvalue().encode("utf-8", "surrogatepass")


_ELEMENTS = (
    '<include file="../../../etc/passwd"/>', '<size memory="900G"/>', '<size nuserdata="1000000000"/>',
    '<mesh name="m" file="../../../etc/passwd"/>', '<option timestep="-1"/>',
    '<texture type="2d" builtin="flat" width="99999" height="99999"/>',
    '<hfield name="h" nrow="100000" ncol="100000" size="1 1 1 1"/>', '<plugin plugin="x.y"/>',
    '<composite type="particle" count="9999 9999 9999" spacing="1"/>', '<replicate count="1000000"><body/></replicate>',
)  # fmt: skip
_PLAIN = [str(value) for value in (*NUMBERS, *TEXTS) if "\0" not in str(value)]


def mutated_xml(data: bytes, random: Random) -> bytes:
    if random.random() < 0.3:
        return mutated_bytes(data, random)
    root = ET.fromstring(data)
    elements = list(root.iter())
    for _ in range(random.choice((1, 1, 2, 3))):
        element, kind = random.choice(elements), random.randrange(7)
        if kind == 0 and len(element):
            element.remove(random.choice(list(element)))
        elif kind == 1:
            others = [other for other in elements if element not in other.iter()]
            element.extend(random.sample(others, min(1, len(others))))
        elif kind == 2:
            element.tag = random.choice([other.tag for other in elements] + ["x"])
        elif kind == 3:
            element.append(ET.fromstring(random.choice(_ELEMENTS)))
        elif element.attrib:
            name = random.choice((*element.attrib, "file", "memory"))
            element.set(name, " ".join(random.choices(_PLAIN, k=random.choice((1, 1, 3)))))
            if kind == 4:
                del element.attrib[name]
    return ET.tostring(root)


_RAISES = (
    "raise BaseException", "raise KeyboardInterrupt", "raise SystemExit(0)", "raise GeneratorExit", "raise ValueError",
    "import sys; sys.exit()", "class Odd(BaseException): pass\nraise Odd('x')", "import no_such_module",
    "raise OSError(2, 'x', 'y')", "open('/nowhere')", "def deep(): deep()\ndeep()", "raise UnicodeError", "1 / 0",
    "raise ExceptionGroup('x', [ValueError()])", "raise StopIteration", "del World", "del lw", "x x", "\0", "\u202e",
)  # fmt: skip


def mutated_task(data: bytes, random: Random) -> bytes:
    """Truncate a task's file, or insert a statement that raises an error between its top-level statements."""
    places = [place for place in range(len(data)) if data.startswith((b"\n@", b"\nclass"), place)] + [0, len(data)]
    place = random.choice(places)
    statement = random.choice(_RAISES).encode()
    return data[:place] if random.random() < 0.2 else data[:place] + b"\n" + statement + b"\n" + data[place:]


def _mutated_archive(data: bytes, random: Random, main: str, hostile: bytes) -> bytes:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        entries = [(name, archive.read(name)) for name in archive.namelist()]
    mains = [entry for entry in entries if entry[0].endswith(main)]
    place = entries.index(random.choice(mains if random.random() < 0.5 else entries))
    name, content = entries[place]
    new = random.choice((
        [], [(name, content), (name, mutated_bytes(content, random))], [("../x", content)], [(name.upper(), content)],
        [(name, hostile)], [(name, mutated_bytes(content, random))],
    ))  # fmt: skip
    file = io.BytesIO()
    with warnings.catch_warnings(), zipfile.ZipFile(file, "w") as archive:
        warnings.simplefilter("ignore")  # an archive may contain two files of the same name
        for entry in (*entries[:place], *new, *entries[place + 1 :]):
            archive.writestr(*entry)
    return file.getvalue()


def mutated_checkpoint(data: bytes, random: Random, canary: Path) -> bytes:
    kind = random.randrange(4)
    if kind == 0:
        return mutated_bytes(data, random)
    if kind == 1:
        return _mutated_archive(data, random, "data.pkl", pickle.dumps(Canary(canary), protocol=2))
    content = torch.load(io.BytesIO(data), weights_only=True)
    file = io.BytesIO()
    torch.save(mutated_value(content, random, (*VALUES, Canary(canary), torch.zeros(3), (1, 2), b"x")), file)
    return file.getvalue()


def _saved(array: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


def mutated_episode(data: bytes, random: Random, canary: Path, main: str = "info") -> bytes:
    kind = random.randrange(4)
    if kind == 0:
        return mutated_bytes(data, random)
    if kind == 1:
        return _mutated_archive(data, random, f"{main}.npy", _saved(np.array([Canary(canary)], dtype=object)))
    with np.load(io.BytesIO(data)) as file:
        arrays = dict(file)
    if kind == 2 and main == "info":
        arrays["info"] = np.array(mutated_json(str(arrays["info"]).encode(), random).decode("utf-8", "replace"))
    else:
        name = random.choice(list(arrays))
        a = np.atleast_1d(arrays[name])
        nan = np.full_like(a, np.nan) if a.dtype.kind == "f" else a.astype("S3")
        arrays[name] = random.choice((a[:-1], a[None], a[..., None], a[:0], np.repeat(a, 2, 0), a.astype("S3"), nan))
    new = io.BytesIO()
    np.savez(new, **arrays)
    return new.getvalue()


def mutated_pickle(data: bytes, random: Random, canary: Path) -> bytes:
    if random.random() < 0.4:
        return mutated_bytes(data, random)
    values = (*VALUES, Canary(canary), np.zeros((2, 3)), np.array([Canary(canary)]), np.float32(1.0), b"x", (1, 2))
    content = mutated_value(pickle.loads(data), random, values)
    return pickle.dumps(content, protocol=random.randrange(6))


def mutated_table(data: bytes, random: Random, canary: Path) -> bytes:
    kind = random.randrange(5)
    if kind == 0:
        return mutated_bytes(data, random)
    if kind == 1:
        return _saved(np.array([Canary(canary)], dtype=object))
    table = np.load(io.BytesIO(data))
    if kind < 4:
        table = random.choice((table[:0], table[0], table[None], table.astype("U3"), table.astype(complex), table == 0))
    else:
        table.flat[random.randrange(table.size)] = random.choice((np.nan, np.inf, 1e300, -1e9))
    return _saved(table)
