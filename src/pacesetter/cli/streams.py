"""Where words go: an answer to stdout, all else to stderr, and to nowhere once nobody reads."""

import io
import os
import select
import sys
from contextlib import AbstractContextManager, redirect_stdout
from typing import Any

UNREAD = 141  # what a shell says of a program that a broken pipe ended


class Stream(io.RawIOBase):
    """A descriptor that is written to and never raises: what nobody can read is dropped."""

    def __init__(self, number: int, lost: bool = False) -> None:
        self._number, self.lost = number, lost

    def fileno(self) -> int:
        return self._number

    def writable(self) -> bool:
        return True

    def isatty(self) -> bool:
        return os.isatty(self._number)

    def write(self, data: Any, /) -> int:
        """How much was written; all of it, once that fails for good."""
        while not self.lost:
            try:
                return os.write(self._number, data)
            except BlockingIOError:  # a reader that is slow is no reader that is gone
                select.select([], [self._number], [])
            except OSError:
                self.lost = True
                _open_to_nowhere(self._number)
        return memoryview(data).nbytes


def guard() -> Stream:
    """Keep this process's stdout for the answer, which is returned, and let no output stop it.

    What prints to descriptor 1 without Python, such as a simulator, prints to stderr from now on.
    """
    closed = [number for number in range(3) if not _is_open(number)]
    for number in closed:  # lest a file of the run becomes stderr
        _open_to_nowhere(number)
    answer, other = Stream(os.dup(1), lost=1 in closed), Stream(2)
    os.dup2(2, 1)
    sys.stdout = sys.__stdout__ = _text(answer, answer.isatty())
    sys.stderr = sys.__stderr__ = _text(other, True)
    return answer


def aside() -> AbstractContextManager[Any]:
    """A place where tasks are played: what they print is no part of the answer."""
    return redirect_stdout(sys.stderr)


def _text(stream: Stream, lines: bool) -> io.TextIOWrapper:
    """Text as people's terminals take it; a character that they do not know is no failure."""
    encoding = getattr(sys.__stdout__ or sys.__stderr__, "encoding", "utf-8")
    return io.TextIOWrapper(
        io.BufferedWriter(stream), encoding, "backslashreplace", line_buffering=lines
    )


def _is_open(number: int) -> bool:
    try:
        os.fstat(number)
    except OSError:
        return False
    return True


def _open_to_nowhere(number: int) -> None:
    nowhere = os.open(os.devnull, os.O_RDWR)
    if nowhere != number:
        os.dup2(nowhere, number)
        os.close(nowhere)
    os.set_inheritable(number, number <= 2)
