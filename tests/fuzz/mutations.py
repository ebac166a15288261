"""Mutate files and values at random: a seed alone determines a mutation."""

import csv
import io
import json
import math
import pickle
import struct
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
    "%s{}", "\u202e\u0301", "ä" * 20, "x" * 5000,
)  # fmt: skip
VALUES = (*NUMBERS, *TEXTS, None, True, False, [], {}, [0], [[1.5]], [None], {"x": 1}, {"": []})
"""Values of the types of JSON, most of them wrong wherever they stand."""


class Canary:
    """An object whose pickle writes a file when it is loaded without care.

    Args:
        file: The file.
    """

    def __init__(self, file: Path) -> None:
        self.file = file

    def __reduce__(self) -> tuple[Any, ...]:
        return (eval, (f"open({str(self.file)!r}, 'w').close()",))


# bytes


def mutated_bytes(data: bytes, random: Random) -> bytes:
    """Bytes with one to four places changed."""
    for _ in range(random.choice((1, 1, 1, 2, 4))):
        data = _changed(data, random.choice(_CHANGES), random)
    return data


_CHANGES = ("flip", "flip", "delete", "duplicate", "insert", "truncate", "swap", "overwrite")


def _changed(data: bytes, change: str, random: Random) -> bytes:
    if change == "flip":
        changed = bytearray(data)
        for _ in range(random.choice((1, 1, 8)) if data else 0):
            changed[random.randrange(len(changed))] ^= 1 << random.randrange(8)
        return bytes(changed)
    if change == "truncate":
        return data[: random.choice((0, 1, random.randrange(len(data) + 1), max(0, len(data) - 1)))]
    start, stop = _span(data, random)
    if change == "delete":
        return data[:start] + data[stop:]
    if change == "duplicate":
        return data[:stop] + data[start:]
    if change == "insert":
        new = (b"\0" * 9, b"\xff\xfe\xfd", b"nan", b"inf", b"-1", b"9" * 40, b"1e999", random.randbytes(16), b"\r")
        return data[:start] + random.choice(new) + data[start:]
    if change == "overwrite":
        word = struct.pack(random.choice(("<q", ">q", "<i", "<d")), random.choice((0, -1, 10**9, 2**31 - 1)))
        return data[:start] + word + data[start + len(word) :]
    (a, b), (c, d) = sorted(((start, stop), _span(data, random)))
    return data if b > c else data[:a] + data[c:d] + data[b:c] + data[a:b] + data[d:]


def _span(data: bytes, random: Random) -> tuple[int, int]:
    start = random.randrange(len(data) + 1)
    return start, min(len(data), start + random.randint(1, 64))


# values


def mutated_value(tree: Any, random: Random, values: tuple[Any, ...] = VALUES) -> Any:
    """A nested value with one entry changed: another value, no entry, one entry more, or the entry far too deep."""
    if isinstance(tree, dict) and tree and random.random() < 0.9:
        name = random.choice(list(tree))
        kind = random.randrange(10)
        if kind == 0:
            return {key: value for key, value in tree.items() if key != name}
        if kind == 1:
            return {**tree, random.choice(TEXTS): random.choice(values)}
        return {**tree, name: mutated_value(tree[name], random, values)}
    if isinstance(tree, list) and tree and random.random() < 0.7:
        place = random.randrange(len(tree))
        kind = random.randrange(6)
        if kind == 0:
            return tree[:place] + tree[place + 1 :]
        if kind == 1:
            return [*tree, random.choice(values)]
        return [*tree[:place], mutated_value(tree[place], random, values), *tree[place + 1 :]]
    if isinstance(tree, torch.Tensor) and random.random() < 0.8:
        return _mutated_tensor(tree, random)
    if random.random() < 0.1:
        return [tree]
    return random.choice(values)


def _mutated_tensor(tensor: torch.Tensor, random: Random) -> torch.Tensor:
    kind = random.randrange(6)
    if kind == 0:
        return torch.zeros(1).expand(10**9)  # a shape of 4 GB in four bytes
    if kind == 1:
        return tensor.to(random.choice((torch.float64, torch.bool, torch.complex64, torch.int64)))
    if kind == 2:
        return tensor.flatten()[:-1] if tensor.numel() > 1 else tensor[None]
    if kind == 3:
        return tensor[None]
    if kind == 4:
        return tensor.to_sparse()
    changed = tensor.clone().flatten()
    if changed.numel():
        number = random.choice((math.nan, math.inf, 1e30) if changed.is_floating_point() else (-1, 10**6))
        changed[random.randrange(changed.numel())] = number
    return changed.view(tensor.shape)


# text files


def mutated_json(data: bytes, random: Random) -> bytes:
    """A JSON document with an entry changed, dropped, repeated or far too deep."""
    if random.random() < 0.3:
        return mutated_bytes(data, random)
    if random.random() < 0.05:
        return random.choice((b"[" * 100_000, b'{"a":' * 50_000, b"[]", b"null", b"9" * 5000, b"\xef\xbb\xbf" + data))
    tree = json.loads(data)
    for _ in range(random.choice((1, 1, 2))):
        tree = mutated_value(tree, random)
    text = json.dumps(tree, indent=2)
    if random.random() < 0.05:  # a key twice
        text = text.replace("{", '{"' + random.choice(list(json.loads(data))) + '": ' + random.choice("0[") + "],", 1)
    return text.encode("utf-8", "surrogatepass")


def mutated_csv(data: bytes, random: Random) -> bytes:
    """A table with a cell, a name, a row or a column changed."""
    if random.random() < 0.4:
        return mutated_bytes(data, random)
    rows = list(csv.reader(io.StringIO(data.decode())))
    row = random.choice(rows)
    column = random.randrange(len(row))
    kind = random.randrange(7)
    if kind == 0:
        del row[column]
    elif kind == 1:
        row.insert(column, random.choice(TEXTS))
    elif kind == 2:
        rows.remove(row)
    elif kind == 3:
        rows.insert(random.randrange(len(rows)), list(row))
    elif kind == 4:
        row[column] = "1" * 200_000  # longer than a cell may be
    else:
        row[column] = str(random.choice((*NUMBERS, *TEXTS)))
    text = io.StringIO()
    csv.writer(text).writerows(rows)
    return text.getvalue().encode()


def mutated_xml(data: bytes, random: Random) -> bytes:
    """A model with an element or an attribute changed."""
    if random.random() < 0.3:
        return mutated_bytes(data, random)
    root = ET.fromstring(data)
    elements = list(root.iter())
    for _ in range(random.choice((1, 1, 2, 3))):
        element = random.choice(elements)
        kind = random.randrange(8)
        if kind == 0 and len(element):
            element.remove(random.choice(list(element)))
        elif kind == 1:
            others = [other for other in elements if element not in other.iter()]
            element.extend(random.sample(others, min(1, len(others))))
        elif kind == 2:
            element.tag = random.choice([other.tag for other in elements] + ["x"])
        elif kind == 3:
            element.set(random.choice(("file", "name", "class", "size", "nuser_body", "memory", "type", "x")), "1e9")
        elif kind == 4:
            element.append(ET.fromstring(random.choice(_ELEMENTS)))
        elif element.attrib:
            name = random.choice(list(element.attrib))
            if kind == 5:
                del element.attrib[name]
            else:
                plain = [str(value) for value in (*NUMBERS, *TEXTS) if "\0" not in str(value)]
                element.set(name, " ".join(random.choices(plain, k=random.choice((1, 1, 3)))))
    return ET.tostring(root)


_ELEMENTS = (
    '<include file="../../../etc/passwd"/>', '<size memory="900G"/>', '<size nuserdata="1000000000"/>',
    '<mesh name="m" file="../../../etc/passwd"/>', '<option timestep="-1"/>',
    '<texture type="2d" builtin="flat" width="99999" height="99999"/>',
    '<hfield name="h" nrow="100000" ncol="100000" size="1 1 1 1"/>', '<plugin plugin="x.y"/>',
    '<composite type="particle" count="9999 9999 9999" spacing="1"/>', '<replicate count="1000000"><body/></replicate>',
)  # fmt: skip


def mutated_python(data: bytes, random: Random) -> bytes:
    """A program with some bytes, a word or a line changed."""
    lines = data.decode().splitlines(keepends=True)
    kind = random.randrange(4)
    place = random.randrange(len(lines))
    if kind == 0:
        return mutated_bytes(data, random)
    if kind == 1:
        del lines[place]
    elif kind == 2:
        lines.insert(random.randrange(len(lines)), lines[place])
    else:
        words = lines[place].split(" ")
        words[random.randrange(len(words))] = str(random.choice((0, -1, "None", "''", "qvel", "float", "raise", "1e9")))
        lines[place] = " ".join(words).rstrip("\n") + "\n"
    return "".join(lines).encode()


# archives


def _entries(data: bytes) -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def _archive(entries: list[tuple[str, bytes]], claimed: tuple[str, int] | None = None) -> bytes:
    """An archive; one entry may claim another size than it has."""
    file = io.BytesIO()
    with warnings.catch_warnings(), zipfile.ZipFile(file, "w") as archive:
        warnings.simplefilter("ignore")  # a name twice
        for name, content in entries:
            archive.writestr(name, content)
        for entry in archive.filelist:
            if claimed is not None and entry.filename == claimed[0]:
                entry.file_size = entry.compress_size = claimed[1]
    return file.getvalue()


def _mutated_archive(data: bytes, random: Random, main: str, hostile: bytes) -> bytes:
    """An archive with an entry changed, dropped, repeated, renamed or replaced by a hostile one."""
    entries = list(_entries(data).items())
    place = next(i for i, (name, _) in enumerate(entries) if name.endswith(main))
    if random.random() < 0.5:
        place = random.randrange(len(entries))
    name, content = entries[place]
    kind = random.randrange(7)
    if kind == 0:
        del entries[place]
    elif kind == 1:
        entries.append((name, mutated_bytes(content, random)))
    elif kind == 2:
        entries[place] = (random.choice(("../x", "/x", " ", name.upper(), name + "/x")), content)
    elif kind == 3:
        entries[place] = (name, hostile)
    elif kind == 4:
        return _archive(entries, (name, random.choice((0, 10**6, 3 * 10**9, 2**32 - 1))))
    else:
        entries[place] = (name, mutated_bytes(content, random))
    return _archive(entries)


def mutated_checkpoint(data: bytes, random: Random, canary: Path) -> bytes:
    """A file of torch with bytes, entries of the archive, the pickle or the saved values changed."""
    kind = random.randrange(4)
    if kind == 0:
        return mutated_bytes(data, random)
    if kind == 1:
        hostile = pickle.dumps(Canary(canary), protocol=2)
        return _mutated_archive(data, random, "data.pkl", hostile)
    content = torch.load(io.BytesIO(data), weights_only=True)
    for _ in range(random.choice((1, 1, 2))):
        content = mutated_value(content, random, (*VALUES, Canary(canary), torch.zeros(3), (1, 2), b"x"))
    file = io.BytesIO()
    torch.save(content, file)
    return file.getvalue()


def mutated_episode(data: bytes, random: Random, canary: Path) -> bytes:
    """An archive of numpy with bytes, entries, arrays or the description of the episode changed."""
    kind = random.randrange(4)
    if kind == 0:
        return mutated_bytes(data, random)
    if kind == 1:
        return _mutated_archive(data, random, "info.npy", _object_array(canary))
    with np.load(io.BytesIO(data)) as file:
        arrays = dict(file)
    if kind == 2:
        arrays["info"] = np.array(mutated_json(str(arrays["info"]).encode(), random).decode("utf-8", "replace"))
    else:
        name = random.choice(list(arrays))
        changes = (
            lambda a: a[:-1] if a.ndim else a[None], lambda a: a[None], lambda a: a.astype("S3"),
            lambda a: a[..., None], lambda a: np.zeros((0, *a.shape[1:]), a.dtype),
            lambda a: np.repeat(a, 2, 0) if a.ndim else a,
            lambda a: np.full_like(a, np.nan) if a.dtype.kind == "f" else a.astype("f2") if a.ndim else np.array(5),
        )  # fmt: skip
        arrays[name] = random.choice(changes)(arrays[name])
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


def _object_array(canary: Path) -> bytes:
    file = io.BytesIO()
    np.save(file, np.array([Canary(canary)], dtype=object), allow_pickle=True)
    return file.getvalue()


def mutated_table(data: bytes, random: Random, canary: Path) -> bytes:
    """An array of numpy with bytes, its header, its type or its numbers changed."""
    kind = random.randrange(5)
    if kind == 0:
        return mutated_bytes(data, random)
    if kind == 1:
        return _object_array(canary)
    table = np.load(io.BytesIO(data))
    if kind == 2:  # the header's shape, in as many letters
        shape = str(table.shape).encode()
        other = random.choice((b"(9999999999,)", b"(-1, 4)", b"(1e9,)", b"(2, 10**9)", b"()"))
        return data.replace(shape + b", }" + b" " * max(0, len(other) - len(shape)), other + b", }", 1)
    if kind == 3:
        table = random.choice((table[:0], table[0], table[None], table.astype("U3"), table.astype(complex), table == 0))
    else:
        table = table.copy()
        table.flat[random.randrange(table.size)] = random.choice((np.nan, np.inf, 1e300, -1e9))
    file = io.BytesIO()
    np.save(file, table)
    return file.getvalue()
