"""Seeded damage to files: of bytes, of texts by their tokens, of known formats by their structure."""

from __future__ import annotations

import contextlib
import json
import os
import re
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from lanenet.perception.network.model_file import HASH_NAME, sealed

#: What a number, or any value, is replaced by.
VALUES = (
    *(b"0", b"-1", b"1e308", b"-1e308", b"1e999", b"nan", b".nan", b".inf", b"Infinity", b"1" + b"0" * 30),
    *(
        b"9" * 5000,
        b"true",
        b"yes",
        b"null",
        b"1:30",
        b"010",
        b"1_0",
        b"0x7fffffff",
        b"2147483648",
        b"''",
        b"",
    ),
    *(
        b"[]",
        b"{}",
        b"[[[[1]]]]",
        b'"text"',
        b"2024-13-45",
        b"!!python/object x",
        b"&a [*a]",
        b"1e-320",
        b"-0",
    ),
)
#: What a name is replaced by; `canary` files lie beside the folder of a case.
NAMES = (
    *(b"../canary.txt", b"../canary.jpg", b"../../etc/passwd", b"/etc/passwd", b"/dev/zero", b"/dev/stdin"),
    *(
        b"pipe",
        b"../pipe",
        b".",
        b"..",
        b"a" * 5000,
        b"a\0b",
        b"\x1b[2J[red]x",
        b"\xff\xfe",
        b"-",
        b"~root/x",
    ),
)
NUMBER = re.compile(rb"(?<![\w.])-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?(?![\w.])")
NAME = re.compile(rb"[\w./-]+\.(?:jpg|png|csv|yaml|catalog|onnx|parquet)")
DEEP = 20_000

Mutation = Callable[[bytes, np.random.Generator], bytes]


def pick(rng: np.random.Generator, options: tuple[Any, ...] | list[Any]) -> Any:
    return options[int(rng.integers(len(options)))]


def flip(data: bytes, rng: np.random.Generator) -> bytes:
    damaged = bytearray(data)
    for at in rng.integers(len(damaged), size=int(rng.integers(1, 9))) if damaged else ():
        damaged[at] ^= 1 << int(rng.integers(8))
    return bytes(damaged)


def overwrite(data: bytes, rng: np.random.Generator) -> bytes:
    """Put the largest, smallest or most common numbers of 1, 2, 4 or 8 bytes somewhere."""
    at, kind = int(rng.integers(len(data) + 1)), pick(rng, (">I", "<I", "<Q", ">H", "B"))
    top = 256 ** struct.calcsize(kind) - 1
    word = struct.pack(kind, pick(rng, (0, 1, top, top >> 1, (top >> 1) + 1)))
    return data[:at] + word + data[at + len(word) :]


def truncate(data: bytes, rng: np.random.Generator) -> bytes:
    return data[: int(rng.integers(len(data) + 1))]


def splice(data: bytes, rng: np.random.Generator) -> bytes:
    """Move, repeat or drop a part."""
    a, b, at = sorted(int(x) for x in rng.integers(len(data) + 1, size=3))
    return pick(rng, (data[:at] + data[a:b] + data[at:], data[:a] + data[b:], data[b:] + data[:a], data * 3))


def replaced(pattern: re.Pattern[bytes], options: tuple[bytes, ...]) -> Mutation:
    def mutate(data: bytes, rng: np.random.Generator) -> bytes:
        found = list(pattern.finditer(data))
        if not found:
            return flip(data, rng)
        span = pick(rng, found).span()
        return data[: span[0]] + pick(rng, options) + data[span[1] :]

    return mutate


def repeat_line(data: bytes, rng: np.random.Generator) -> bytes:
    lines = data.split(b"\n")
    at = int(rng.integers(len(lines)))
    times = pick(rng, (1, 2, 5_000 if len(data) < 10_000 else 3))
    return b"\n".join([*lines[:at], *[lines[at]] * times, *lines[at:]])


def deepen(data: bytes, rng: np.random.Generator) -> bytes:
    at = int(rng.integers(len(data) + 1))
    return data[:at] + pick(rng, (b"[", b'{"a":', b"- ", b'"', b"(", b",")) * DEEP + data[at:]


def swap_cells(data: bytes, rng: np.random.Generator) -> bytes:
    rows = [line.split(b",") for line in data.split(b"\n")]
    row = pick(rng, rows)
    row[int(rng.integers(len(row)))] = pick(rng, (*VALUES, *NAMES))
    return b"\n".join(b",".join(row) for row in rows)


def swap_json(data: bytes, rng: np.random.Generator) -> bytes:
    """Exchange a value anywhere in the tree, or drop its key."""
    lines = data.split(b"\n") if data.count(b"\n") < 12 and not data.startswith(b"{\n") else [data]
    at = int(rng.integers(len(lines)))
    try:
        tree = {"": json.loads(lines[at])}
    except ValueError:
        return flip(data, rng)
    node: Any = tree
    while True:
        keys = list(node) if isinstance(node, dict) else list(range(len(node)))
        key = pick(rng, keys)
        if not isinstance(node[key], dict | list) or not node[key] or rng.random() < 0.2:
            break
        node = node[key]
    odd = (
        None,
        True,
        -1,
        0,
        1e308,
        10**400,
        "",
        "x",
        [],
        {},
        [[]],
        float("nan"),
        float("inf"),
        "../canary.txt",
    )
    if rng.random() < 0.2 and node is not tree:
        del node[key]
    else:
        node[key] = pick(rng, odd)
    lines[at] = json.dumps(tree[""]).encode()
    return b"\n".join(lines)


def swap_png(data: bytes, rng: np.random.Generator) -> bytes:
    size = struct.pack(">II", *(int(pick(rng, (0, 1, 30_000, 65_535, 2**31 - 1))) for _ in range(2)))
    return data[:16] + size + data[24:]


def swap_onnx(data: bytes, rng: np.random.Generator) -> bytes:
    """Change the model or its description, and seal it again."""
    import onnx

    model = onnx.load_from_string(data)
    kept = [(p.key, p.value) for p in model.metadata_props if p.key != HASH_NAME]
    del model.metadata_props[:]
    at = int(rng.integers(len(kept)))
    for k, (key, value) in enumerate(kept):
        entry = model.metadata_props.add()
        entry.key, entry.value = key, value
        if k == at:
            entry.value = pick(rng, (swap_json, flip, deepen))(value.encode(), rng).decode("utf-8", "replace")
    if rng.random() < 0.5:
        return sealed(model.SerializeToString())
    return sealed(pick(rng, (flip, overwrite, truncate))(model.SerializeToString(), rng))


def swap_safetensors(data: bytes, rng: np.random.Generator) -> bytes:
    length = struct.unpack_from("<Q", data)[0]
    header = pick(rng, (swap_json, flip, deepen))(data[8 : 8 + length], rng)
    return struct.pack("<Q", len(header)) + header + data[8 + length :]


def swap_parquet(data: bytes, rng: np.random.Generator) -> bytes:
    """Change the metadata, a column's type or its values, in a file that is sound otherwise."""
    import pyarrow
    import pyarrow.parquet

    from lanenet.data.tables import META_KEY

    table = pyarrow.parquet.read_table(pyarrow.BufferReader(data))
    meta = table.schema.metadata[META_KEY]
    at, n = int(rng.integers(table.num_columns)), table.num_rows
    name = table.column_names[at]
    choice = int(rng.integers(6))
    if choice == 0:
        meta = pick(rng, (swap_json, flip, deepen))(meta, rng)
    elif choice == 1:
        table = table.drop_columns([name])
    elif choice == 2:
        odd = pick(
            rng, ([None] * n, ["x"] * n, [1e308] * n, [[1.0]] * n, [b"\xff"] * n, [{"bytes": b""}] * n)
        )
        table = table.set_column(at, name, pyarrow.array(odd))
    elif choice == 3:
        # Many rows that take no room.
        table = pyarrow.concat_tables([table] * int(pick(rng, (0, 2, 2000))))
    elif choice == 4:
        text = pyarrow.DictionaryArray.from_arrays(
            np.zeros(n, np.int32), ["x" * int(pick(rng, (0, 10**6, 10**7)))]
        )
        table = table.set_column(at, name, text)
    else:
        values = pyarrow.array(np.full(n, pick(rng, (np.nan, np.inf, -1.0, 1e300))))
        table = table.set_column(at, name, values)
    sink = pyarrow.BufferOutputStream()
    pyarrow.parquet.write_table(table.replace_schema_metadata({META_KEY: meta}), sink, compression="zstd")
    damaged = bytes(sink.getvalue().to_pybytes())
    return damaged if rng.random() < 0.7 else flip(damaged, rng)


BYTES: tuple[Mutation, ...] = (flip, overwrite, truncate, splice)
TEXTS: tuple[Mutation, ...] = (
    *(
        replaced(NUMBER, VALUES),
        replaced(NUMBER, VALUES),
        replaced(NAME, NAMES),
        repeat_line,
        deepen,
        flip,
        splice,
    ),
)
BY_ENDING: dict[str, tuple[Mutation, ...]] = {
    ".csv": (*TEXTS, swap_cells, swap_cells, swap_cells),
    ".yaml": (*TEXTS, replaced(re.compile(rb"(?<=: )[^\n]+"), (*VALUES, *NAMES))),
    ".json": (*TEXTS, swap_json, swap_json, swap_json),
    ".catalog": (*TEXTS, swap_json, swap_json),
    ".py": (*TEXTS, replaced(re.compile(rb"(?<=: )[^,]+"), (*VALUES, *NAMES))),
    ".png": (*BYTES, swap_png),
    ".onnx": (*BYTES, swap_onnx, swap_onnx, swap_onnx),
    ".safetensors": (*BYTES, swap_safetensors, swap_safetensors),
    ".parquet": (*BYTES, swap_parquet, swap_parquet, swap_parquet),
}


def mutate(folder: Path, rng: np.random.Generator) -> Path:
    """Damage one file of a folder; returns it."""
    path = pick(rng, sorted(p for p in folder.rglob("*") if p.is_file()))
    if rng.random() < 0.06:
        path.unlink()
        # A file that a person names may be a link; one that a drive or a map holds may not lead out of it.
        inside = path.parent != folder
        pick(rng, (_pipe, _folder, _nothing, _dangling, *([_link_out, _device] if inside else ())))(path)
        return path
    data = path.read_bytes()
    for _ in range(int(rng.integers(1, 4))):
        # What knows a format cannot change a file that another one has damaged.
        with contextlib.suppress(Exception):
            data = pick(rng, BY_ENDING.get(path.suffix, BYTES))(data, rng)
    path.write_bytes(data)
    return path


def _pipe(path: Path) -> None:
    os.mkfifo(path)


def _folder(path: Path) -> None:
    path.mkdir()


def _link_out(path: Path) -> None:
    # Beside the folder of the case, from a drive or from its images.
    up = Path(*[".."] * (3 if path.parent.name == "images" else 2))
    path.symlink_to(up / "canary.jpg")


def _device(path: Path) -> None:
    path.symlink_to("/dev/zero")


def _dangling(path: Path) -> None:
    path.symlink_to("nowhere")


def _nothing(path: Path) -> None:
    path.write_bytes(b"")
