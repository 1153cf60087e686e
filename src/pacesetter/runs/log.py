"""The log of a run, metrics.jsonl: one JSON row per line, appended, or cut back to a checkpoint."""

import json
import os
from hashlib import sha256
from pathlib import Path
from typing import Any

from pacesetter.errors import UsageError
from pacesetter.files import present, read_bytes, regular, sync_folder
from pacesetter.runs.records import check_row
from pacesetter.storage import as_json

Row = dict[str, Any]


class Log:
    """A file of rows; one that is not there has none."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def rows(self, *kinds: str) -> list[Row]:
        """All complete rows, or only those of some kinds; others are not parsed."""
        starts = tuple(f'{{"kind": "{kind}"' for kind in kinds) or ""
        try:
            lines = self.read().decode().split("\n")[:-1]
            found = [json.loads(line) for line in lines if line.startswith(starts)]
            for row in found:
                check_row(row)
        except (ValueError, RecursionError) as error:
            raise UsageError(f"{self.path}: damaged: {error}") from None
        return found

    def read(self) -> bytes:
        """All bytes. Raises UsageError if it is no file that can be read."""
        try:
            return read_bytes(self.path) if present(self.path) else b""
        except OSError as error:
            raise UsageError(f"{self.path}: cannot be read: {error.strerror}") from None

    def append(self, row: Row) -> None:
        """Add one line."""
        with open(self.path, "a", encoding="utf-8", opener=regular) as file:
            file.write(as_json(row) + "\n")

    def seal(self) -> tuple[int, str]:
        """Flush it to disk; returns its size in bytes and their SHA-256."""
        if present(self.path):
            with open(self.path, "ab", opener=regular) as file:
                os.fsync(file.fileno())
            sync_folder(self.path.parent)
        data = self.read()
        return len(data), sha256(data).hexdigest()

    def refuse_other(self, size: int, digest: str | None) -> None:
        """Refuse a log that does not begin with the bytes that were sealed.

        Less of it is no other log, as long as its rows can be read. Old seals have no digest.
        """
        data = self.read()
        if len(data) < size:
            self.rows()
        elif digest is not None and sha256(data[:size]).hexdigest() != digest:
            raise UsageError(
                f"{self.path}: its first {size:,} bytes are not those that the checkpoint covers; "
                "put them back, or remove the file to go on without its rows"
            )

    def cut(self, size: int) -> bool:
        """Truncate it to the whole lines that a checkpoint covers; False if rows are missing."""
        kept = self.read()[:size]
        kept = kept[: kept.rfind(b"\n") + 1]
        if present(self.path):
            with open(self.path, "r+b", opener=regular) as file:
                file.truncate(len(kept))
        return len(kept) == size
