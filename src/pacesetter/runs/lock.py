"""A lock that ends with its process, be it killed."""

import errno
import fcntl
import os
import platform
import re
import time
from collections.abc import Generator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from pacesetter.errors import InUseError
from pacesetter.files import regular

# What flock answers where the file system, such as some network ones, has no locks.
_NO_LOCKS = {errno.ENOSYS, errno.ENOLCK, errno.ENOTSUP, errno.EOPNOTSUPP}
WAIT = 0.02  # seconds between two tries to get a lock
TRIES = 3  # before a lock counts as held: `is_held` has it too, for a moment
WITHOUT = "its file system has no locks, so only this machine knows that this process has it"


class ElsewhereError(InUseError):
    """Held by a process of another machine, as the text says, which nobody here can ask."""


class Lock:
    """A file that one process holds at a time; its text says which one.

    Where the file system has no locks, that text is the lock: it counts as long as a process of
    that id lives on this machine.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.is_weak = False  # held by its text alone
        self._file: IO[str] | None = None

    def take(self) -> None:
        """Hold the file until `free`, or until this process ends.

        Raises InUseError if another holds it and OSError if it cannot be opened.
        """
        file = _open(self.path, "a+")
        try:
            self.is_weak = not _flock_soon(file)
            if self.is_weak:
                self._refuse_holder(file)
        except BlockingIOError:
            holder = _text(file) or "another process"
            file.close()
            raise InUseError(
                f"{self.path.parent} is in use by {holder}; wait until it ends, or stop it"
            ) from None
        except BaseException:
            file.close()
            raise
        if not _is_at(self.path, file):
            file.close()
            self.take()
            return
        file.truncate(0)
        file.write(f"process {os.getpid()} on {platform.node()}\n")
        file.flush()
        self._file = file

    def free(self) -> None:
        """Let another process have the file."""
        if self._file is not None:
            if self.is_weak:
                self._file.truncate(0)
            self._file.close()
            self._file = None

    def is_held(self) -> bool:
        """Whether a process holds the file now, or may, as `holder` says."""
        return self.holder() is not None

    def holder(self) -> str | None:
        """Who holds the file now, for people; None if nobody does or it cannot be read.

        Of a process of another machine, on a file system without locks, nobody here can tell
        whether it lives; it counts.
        """
        try:
            with _open(self.path, "r") as file:
                if _flock(file, fcntl.LOCK_SH):
                    return None
                text = _text(file)
                return text if _lives(text) else self._elsewhere(text)
        except BlockingIOError:
            return self._named()
        except OSError:
            return None

    def _named(self) -> str:
        """Who holds the file, by its text."""
        with suppress(OSError), _open(self.path, "r") as file:
            if text := _text(file):
                return text
        return "another process"

    def _refuse_holder(self, file: IO[str]) -> None:
        text = _text(file)
        if _lives(text):
            raise BlockingIOError
        if holder := self._elsewhere(text):
            raise ElsewhereError(f"{self.path.parent} is in use by {holder}")

    def _elsewhere(self, text: str) -> str | None:
        """The holder if it is of another machine, and what a person can do about it."""
        if not text or text.endswith(f" on {platform.node()}"):
            return None
        return (
            f"{text}, and on a file system without locks nobody can tell whether that still runs; "
            f"if it does not, remove {self.path}"
        )


def wait_for(lock: Lock) -> None:
    """Take a lock as soon as it is free.

    Raises ElsewhereError where nobody can tell whether it will ever be.
    """
    while True:
        try:
            lock.take()
            return
        except ElsewhereError:
            raise
        except InUseError:
            time.sleep(WAIT)


@contextmanager
def alone(lock: Lock) -> Generator[None]:
    """Wait for a lock and hold it in the block."""
    wait_for(lock)
    try:
        yield
    finally:
        lock.free()


def _open(path: Path, mode: str) -> IO[str]:
    return open(path, mode, encoding="utf-8", errors="replace", opener=regular)


def _flock(file: IO[str], kind: int) -> bool:
    """Lock a file, or raise BlockingIOError; False where the file system has no locks."""
    try:
        fcntl.flock(file, kind | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            raise
        return False
    return True


def _flock_soon(file: IO[str]) -> bool:
    """Lock a file for this process alone, unless it stays locked for some tries."""
    for _ in range(TRIES - 1):
        with suppress(BlockingIOError):
            return _flock(file, fcntl.LOCK_EX)
        time.sleep(WAIT)
    return _flock(file, fcntl.LOCK_EX)


def _is_at(path: Path, file: IO[str]) -> bool:
    """Whether a file has its name still, which who held it before may have removed."""
    try:
        return os.path.samestat(path.lstat(), os.fstat(file.fileno()))
    except FileNotFoundError:
        return False


def _text(file: IO[str]) -> str:
    file.seek(0)
    return " ".join(file.read(200).split())


def _lives(holder: str) -> bool:
    """Whether the process that a lock's text names lives on this machine."""
    found = re.fullmatch(r"process (\d+) on (.*)", holder)
    if found is None or found[2] != platform.node():
        return False
    try:
        os.kill(int(found[1]), 0)
    except (ProcessLookupError, OverflowError):
        return False
    except OSError:  # it lives, and is another user's
        return True
    return True
