"""What trackers have written, read back: points of (name, step, value)."""

import json
import os
import sqlite3
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pacesetter.runs import RunDirectory

Point = tuple[str, int, float]


def tensorboard(run: RunDirectory) -> list[Point]:
    """TFRecord files: the length, its checksum, the event, its checksum."""
    from tensorboardX.proto.event_pb2 import Event

    points: list[Point] = []
    for file in sorted((run.path / "tensorboard").glob("events.*")):
        data = file.read_bytes()
        while data:
            (size,) = struct.unpack("<Q", data[:8])
            event, data = Event.FromString(data[12 : 12 + size]), data[16 + size :]
            values = [value for value in event.summary.value if value.HasField("simple_value")]
            points += [(value.tag, event.step, value.simple_value) for value in values]
    return points


def wandb(run: RunDirectory) -> list[Point]:
    """One file per start; as the server does, leave out steps that an earlier one has."""
    import wandb as tool

    tool.teardown()  # its process may still write
    points: list[Point] = []
    files = sorted(run.path.glob("wandb/offline-run-*/run-*.wandb"))
    assert len({file.name for file in files}) == 1, "one id for all starts"
    for file in files:
        last = max((step for _, step, _ in points), default=-1)
        for record in _wandb_records(file):
            items = {item.nested_key[0] or item.key: item for item in _items(record)}
            values = {key: json.loads(item.value_json) for key, item in items.items()}
            step = values.get("_step", -1)
            if step > last:
                points += [(k, step, v) for k, v in values.items() if not k.startswith("_")]
    return points


def _items(record: Any) -> list[Any]:
    return list(record.history.item) if record.HasField("history") else []


def _wandb_records(file: Path) -> Iterator[Any]:
    """LevelDB's log: blocks of chunks, each with a checksum, a length and where it stands."""
    from wandb.proto.wandb_internal_pb2 import Record

    data, place, block, parts = file.read_bytes(), 7, 32768, b""
    while place + 7 <= len(data):
        if block - place % block < 7:
            place += block - place % block
            continue
        size, kind = struct.unpack("<HB", data[place + 4 : place + 7])
        parts, place = parts + data[place + 7 : place + 7 + size], place + 7 + size
        if kind in (1, 4):  # a whole record, or the last chunk of one
            yield Record.FromString(parts)
            parts = b""


def trackio(run: RunDirectory) -> list[Point]:
    """Through the tool's own storage."""
    from trackio.sqlite_storage import SQLiteStorage

    (name,) = SQLiteStorage.get_runs("pacesetter")
    rows = SQLiteStorage.get_logs("pacesetter", name)
    hidden = ("step", "timestamp")
    return [(k, row["step"], v) for row in rows for k, v in row.items() if k not in hidden]


def mlflow(run: RunDirectory) -> list[Point]:
    """From the database itself."""
    file = os.environ["MLFLOW_TRACKING_URI"].removeprefix("sqlite:///")
    with sqlite3.connect(file) as base:
        assert base.execute("select status from runs").fetchall() == [("FINISHED",)]
        return base.execute("select key, step, value from metrics").fetchall()
