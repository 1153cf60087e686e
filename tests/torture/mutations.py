"""Files with one odd thing in them: any value, type, size, name, nesting or byte."""

import json
import random
import tomllib
from collections.abc import Callable
from typing import Any

import numpy as np

from pacesetter import storage

Rng = random.Random
Tree = Any
EVIL = "intruder:Intruder-v0"  # a module that leaves a mark when it is imported
WORDS = [
    *("", "x", "nan", "1e999", "../../x", "/etc/passwd", "-1", "0x10", "None", "true", EVIL),
    *("intruder:Learner", "__import__('os')", "${HOME}", "{0.__class__}", "%s%n", "\ud800", "\0"),
    *("\x1b[2J\x1b[31m", "a\nb", "a\r\nb", "\\input{x}", "<script>", "| a | b |", "x" * 10_000),
    *("\u202e", "е", "1" * 400, "9" * 5000, "1_000", "٣", "1e400"),  # noqa: RUF001
]
NUMBERS = [
    *(0, -1, 1, 2, 7, 2**31, 2**63, 2**64, 10**30, 10**400, -(10**400), True, False, 0.5, -0.0),
    *(1e-320, 1e38, 1e308, -1e308, float("nan"), float("inf"), float("-inf")),
]
PARTS: list[Any] = [None, [], {}, [[]], [None], {"": None}, [1] * 300, {"a": {"b": {"c": []}}}]
ODD: list[Any] = [*WORDS, *NUMBERS, *PARTS]


def _nest(rng: Rng, depth: int) -> Any:
    value: Any = 0
    for _ in range(depth):
        value = [value] if rng.random() < 0.5 else {"x": value}
    return value


def odd(rng: Rng) -> Any:
    """One odd value."""
    return _nest(rng, rng.choice([5, 60, 150])) if rng.random() < 0.03 else rng.choice(ODD)


def _places(tree: Tree) -> list[tuple[Any, Any]]:
    """Every (holder, key) below a tree."""
    keys = tree.keys() if isinstance(tree, dict) else range(len(tree))
    found = [(tree, key) for key in keys]
    for key in keys:
        if isinstance(tree[key], (dict, list)):
            found += _places(tree[key])
    return found


def change(tree: Tree, rng: Rng) -> Tree:
    """A tree with one place set, dropped, doubled, swapped or added; the tree itself is changed."""
    places = _places(tree) if isinstance(tree, (dict, list)) else []
    if not places or rng.random() < 0.02:
        return odd(rng)
    holder, key = rng.choice(places)
    what = rng.random()
    if what < 0.6:
        holder[key] = odd(rng)
    elif what < 0.75:
        del holder[key]
    elif what < 0.85:
        other, at = rng.choice(places)
        holder[key] = json.loads(json.dumps(other[at])) if at in _keys(other) else None
    elif isinstance(holder, dict):
        holder[rng.choice(WORDS)] = odd(rng)
    else:
        holder.insert(rng.randrange(len(holder) + 1), odd(rng))
    return tree


def _keys(holder: Any) -> Any:
    return holder if isinstance(holder, dict) else range(len(holder))


def spoil(data: bytes, rng: Rng) -> bytes:
    """Bytes cut, flipped, doubled, dropped, emptied, or not what they were at all."""
    size = max(len(data), 1)
    at, to = sorted(rng.randrange(size + 1) for _ in range(2))
    ways: list[Callable[[], bytes]] = [
        lambda: data[:at],
        lambda: data[:at] + bytes([rng.randrange(256)]) + data[at + 1 :],
        lambda: data[:at] + data[to:],
        lambda: data[:to] + data[at:],
        lambda: data[:at] + rng.choice([b"\0", b"\xff\xfe", b"\xef\xbb\xbf", b"\n"]) + data[at:],
        lambda: b"",
        lambda: b"[" * 100_000,
        lambda: b'{"a":' * 20_000,
        lambda: b"9" * 5_000,
        lambda: rng.randbytes(rng.randrange(1, 4096)),
        lambda: b"\xef\xbb\xbf" + data,
        lambda: data.decode("utf-8", "replace").encode("utf-16"),
    ]
    return rng.choice(ways)()


def json_file(data: bytes, rng: Rng) -> bytes:
    """A JSON file, mostly still JSON."""
    if rng.random() < 0.25:
        return spoil(data, rng)
    return json.dumps(change(json.loads(data), rng)).encode()


def json_lines(data: bytes, rng: Rng) -> bytes:
    """A file of JSON lines with one line changed, doubled, dropped, or moved."""
    if rng.random() < 0.2:
        return spoil(data, rng)
    lines = data.splitlines()
    at = rng.randrange(len(lines))
    if rng.random() < 0.15:
        lines[at], lines[0] = lines[0], lines[at]
    elif rng.random() < 0.1:
        lines = [*lines[:at], *lines[at + 1 :], *lines[:at]]
    else:
        lines[at] = json.dumps(change(json.loads(lines[at]), rng)).encode()
    return b"\n".join(lines) + b"\n"


def toml_file(data: bytes, rng: Rng) -> bytes:
    """A TOML file, mostly still TOML."""
    if rng.random() < 0.2:
        return spoil(data, rng)
    tree = change(tomllib.loads(data.decode()), rng)
    return _toml(tree if isinstance(tree, dict) else {"x": tree}).encode("utf-8", "surrogatepass")


def _toml(table: dict[str, Any]) -> str:
    return "".join(f"{json.dumps(key)} = {_toml_value(value)}\n" for key, value in table.items())


def _toml_value(value: Any) -> str:
    if isinstance(value, dict):
        return (
            "{" + ", ".join(f"{json.dumps(k)} = {_toml_value(v)}" for k, v in value.items()) + "}"
        )
    if isinstance(value, list):
        return "[" + ", ".join(map(_toml_value, value)) + "]"
    text = json.dumps(value)
    return {"null": '"null"', "NaN": "nan", "Infinity": "inf", "-Infinity": "-inf"}.get(text, text)


def tensors(data: bytes, rng: Rng) -> bytes:
    """A safetensors file of ours of ours: bytes spoiled, or odd content with right hashes."""
    if rng.random() < 0.3:
        return spoil(data, rng)
    if rng.random() < 0.1:  # a header that claims any size
        return rng.choice([2**30, 2**63, 0, 1, len(data)]).to_bytes(8, "little") + data[8:]
    manifest, arrays = storage._manifest(data), storage.load(data)
    table = json.loads(manifest["table"])
    if rng.random() < 0.6 or not arrays:
        table = change(table, rng)
    else:
        _change_array(arrays, rng)
    return _pack(manifest["kind"], arrays, table)


def _change_array(arrays: dict[str, Any], rng: Rng) -> None:
    name, other = rng.choice(list(arrays)), rng.choice(list(arrays))
    array = arrays[name]
    ways: list[Callable[[], Any]] = [
        lambda: array.astype(rng.choice([np.float64, np.int32, np.uint8, np.float16, np.bool_])),
        lambda: array.ravel()[: array.size // 2].copy(),
        lambda: array[None].copy(),
        lambda: np.zeros((0,), array.dtype),
        lambda: np.full_like(array, rng.choice([0, 1, 255])),
        lambda: arrays[other],
    ]
    if np.issubdtype(array.dtype, np.floating):
        ways += [lambda: np.full_like(array, rng.choice([np.nan, np.inf, 3e38, -3e38]))]
    arrays[name] = rng.choice(ways)()
    if rng.random() < 0.2:
        del arrays[name]
    elif rng.random() < 0.2:
        arrays[rng.choice(["x", "", "a" * 300, "actors.0.99.kernel", "../x"])] = arrays.pop(name)


def _pack(kind: str, arrays: dict[str, Any], table: Any) -> bytes:
    """As `storage.write` makes it, with right hashes."""
    text = json.dumps(table, sort_keys=True)
    whole = {name: array.copy(order="C") for name, array in arrays.items()}
    hashes = json.dumps({name: storage.digest(array) for name, array in whole.items()})
    table_hash = storage.hashlib.sha256(text.encode()).hexdigest()
    manifest = {"kind": kind, "table": text, "hashes": hashes, "table_hash": table_hash}
    return storage.save(whole, metadata=manifest)
