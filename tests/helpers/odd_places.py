"""What may stand where a file was."""

import os
from pathlib import Path


def pipe(path: Path) -> None:
    """A pipe that nobody writes to."""
    path.unlink()
    os.mkfifo(path)


def folder(path: Path) -> None:
    """A folder with something of a user's in it."""
    path.unlink()
    path.mkdir()
    (path / "inside").write_text("a user's own")
