"""Give the rows of a run to trackers, beside its metrics.jsonl."""

import json
import re
import shlex
import uuid
from collections.abc import Generator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from typing import Any

from pacesetter.consent import words
from pacesetter.errors import TrainingError, UsageError, tell, unknown
from pacesetter.extras import look_for
from pacesetter.files import present, read_bytes, write_atomically
from pacesetter.runs import Row, RunDirectory
from pacesetter.storage import as_json
from pacesetter.tracking.sinks import SINKS, Tracked, Write

FILE = "trackers.json"
NONE = "none"


def chosen(text: str | None) -> list[str] | None:
    """The trackers that `--log` names, each with its package there; None where none are said."""
    if text is None:
        return None
    names = [] if text == NONE else text.split(",")
    if NONE in names:
        raise UsageError(f"log: {NONE} stands alone or not at all, got '{text}'")
    for name in names:
        if name not in SINKS:
            raise unknown("log", name, [*SINKS, NONE])
        look_for("log", SINKS[name].package, f"pacesetter[{name}]")
    return list(dict.fromkeys(names))


@contextmanager
def tracked(directory: RunDirectory, names: Sequence[str] | None = None) -> Generator[Write]:
    """What takes each new row of a run, and gives it to the trackers named.

    Without names, to those that the run had before. The rows that are in the log already are given
    to a tracker that lacks them. A tracker that fails later is left out; the run goes on.
    """
    record = _record(directory)
    used = record["trackers"] if names is None else list(names)
    chosen(",".join(used) or NONE)
    known = list(dict.fromkeys([*record["known"], *used]))
    with ExitStack() as stack:
        _note(directory, record, trackers=used)
        writes = {name: _open(stack, name, _run(directory, record, name)) for name in used}
        _note(directory, record, trackers=used, known=known)

        def write(row: Row) -> None:
            for name, give in list(writes.items()):
                try:
                    give(row)
                except Exception as error:  # of whatever kind its tool raises
                    del writes[name]
                    _say(f"{_failed(name, error)}; goes on without it")

        yield write


def _open(stack: ExitStack, name: str, run: Tracked) -> Write:
    sink = SINKS[name].open(run)
    try:
        write = sink.__enter__()
    except UsageError:
        raise
    except Exception as error:
        own = run.settings
        allow = words(own["algorithm"], own["env"], *own.get("wrap", ()))  # old ones name none
        resume = shlex.join(["pacesetter", "resume", str(run.folder), *allow, "--log", NONE])
        said = f"log: {_failed(name, error)}; `{resume}` goes on without it"
        raise TrainingError(said) from error
    stack.callback(_close, name, sink)
    return write


def _close(name: str, sink: AbstractContextManager[Write]) -> None:
    try:
        sink.__exit__(None, None, None)
    except Exception as error:  # the run itself has ended well
        _say(_failed(name, error))


def _say(line: str) -> None:
    tell(f"log: {line}")


def _failed(name: str, error: Exception) -> str:
    return f"{name} failed: {type(error).__name__}: {error}"


def _run(directory: RunDirectory, record: dict[str, Any], name: str) -> Tracked:
    settings = directory.settings()
    group = f"{settings['env']} {settings['name']}"
    return Tracked(
        directory.path,
        record["id"],
        f"{group} {settings['seed']}",
        group,
        settings,
        directory.rows(),
        name not in record["known"],
    )


def _note(directory: RunDirectory, record: dict[str, Any], **changes: Any) -> None:
    """Keep what a resumed run must know, where it is new."""
    if record | changes != record:
        table = as_json(record | changes)
        write_atomically(directory.path / FILE, f"{table}\n".encode())


def _record(directory: RunDirectory) -> dict[str, Any]:
    """The run's id in all trackers, those that it uses, and those that know it."""
    file = directory.path / FILE
    if not present(file):
        return {"id": uuid.uuid4().hex[:8], "trackers": [], "known": []}
    try:
        table = json.loads(read_bytes(file))
        if not re.fullmatch("[0-9a-f]{8}", table["id"]):  # it becomes a part of file names
            raise ValueError(f"id {table['id']}")
        lists = {key: [*map(str, table[key])] for key in ("trackers", "known")}
        return {"id": table["id"]} | lists
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise UsageError(f"{file}: damaged: {error}; remove it") from None
