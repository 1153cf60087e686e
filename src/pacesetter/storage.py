"""Arrays and JSON in one file: safetensors, hashed, replaced atomically, read without trust."""

import hashlib
import json
from collections.abc import Mapping
from math import isfinite
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load, save

from pacesetter.errors import UsageError
from pacesetter.files import read_bytes, write_atomically
from pacesetter.types import Arrays

# What reading a damaged or hostile file may raise besides UsageError.
FAULTS = (
    SafetensorError,
    ValueError,
    LookupError,
    TypeError,
    AttributeError,
    ArithmeticError,
    RecursionError,
    MemoryError,
)


class Content(NamedTuple):
    """What a file holds: arrays by name and one JSON table."""

    arrays: Arrays
    table: dict[str, Any]


def as_json(value: Any, **how: Any) -> str:
    """A value as JSON that every reader takes: null for NaN and infinities, which JSON has not."""
    try:
        return json.dumps(value, allow_nan=False, **how)
    except ValueError:
        return json.dumps(_finite(value), allow_nan=False, **how)


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(each) for key, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(each) for each in value]
    return None if isinstance(value, float) and not isfinite(value) else value


def digest(array: NDArray[Any]) -> str:
    """SHA-256 of an array's bytes in C order."""
    return hashlib.sha256(np.ascontiguousarray(array).data).hexdigest()


def write(path: Path, kind: str, content: Content, keep: Path | None = None) -> None:
    """Write arrays and table with the hash of each array."""
    # safetensors 0.8 silently writes wrong bytes for transposed or sliced arrays.
    arrays = {name: array.copy(order="C") for name, array in content.arrays.items()}
    hashes = {name: digest(array) for name, array in arrays.items()}
    table = json.dumps(content.table, sort_keys=True)
    manifest = {
        "kind": kind,
        "table": table,
        "hashes": json.dumps(hashes, sort_keys=True),
        "table_hash": hashlib.sha256(table.encode()).hexdigest(),
    }
    write_atomically(path, _ordered(save(arrays, metadata=manifest)), keep)


def _ordered(data: bytes) -> bytes:
    """The file with its header in order, which safetensors shuffles: equal files, equal bytes."""
    size = int.from_bytes(data[:8], "little")
    header = json.loads(data[8 : 8 + size])
    header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
    text = json.dumps(header).encode()
    text = text.ljust(-(-len(text) // 8) * 8)  # arrays begin at a multiple of 8
    return len(text).to_bytes(8, "little") + text + data[8 + size :]


def read(path: Path, kind: str) -> Content:
    """Read a file that `write` made, or refuse it in one line: foreign, damaged or missing."""
    try:
        data = read_bytes(path)
        manifest = _manifest(data)
        if manifest.get("kind") != kind:
            raise UsageError(f"{path}: is not a pacesetter {kind}")
        arrays = load(data)
        hashes: Mapping[str, str] = json.loads(manifest["hashes"])
        damaged = [name for name in {*arrays, *hashes} if not _intact(name, arrays, hashes)]
        if hashlib.sha256(manifest["table"].encode()).hexdigest() != manifest["table_hash"]:
            damaged.append("its table")
        if damaged:
            raise UsageError(f"{path}: damaged: {', '.join(sorted(damaged)[:3])}")
        table = json.loads(manifest["table"])
        if not isinstance(table, dict):
            raise ValueError("its table is not a table")
        return Content(arrays, table)
    except FileNotFoundError:
        raise UsageError(f"{path}: no such file") from None
    except OSError as error:
        raise UsageError(f"{path}: cannot be read: {error.strerror}") from None
    except FAULTS as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise UsageError(f"{path}: damaged or foreign: {reason}") from None


def _manifest(data: bytes) -> dict[str, str]:
    size = int.from_bytes(data[:8], "little")
    if not 2 <= size <= len(data) - 8:
        raise ValueError("its header is truncated")
    header = json.loads(data[8 : 8 + size])
    return header.get("__metadata__", {})


def _intact(name: str, arrays: Arrays, hashes: Mapping[str, str]) -> bool:
    return name in arrays and name in hashes and digest(arrays[name]) == hashes[name]
