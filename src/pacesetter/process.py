"""A command's process: its cores and threads, and how signals end it."""

import os
import signal
from collections.abc import Callable, Generator
from contextlib import contextmanager
from types import FrameType

from pacesetter.errors import UsageError


def cores() -> list[int]:
    """The cores that this process may use."""
    return sorted(os.sched_getaffinity(0))


def threads() -> int:
    """The size of XLA's thread pool on a CPU: NPROC, by default one thread per core.

    It decides the last bits of results. Raises UsageError if NPROC is anything else.
    """
    text = os.environ.get("NPROC", "").strip()
    if not text:
        return len(cores())
    if not (text.isdecimal() and int(text) >= 1):
        raise UsageError(
            f"NPROC: must be a whole number of threads, at least 1, got '{text}'; "
            "unset it for one thread per core"
        )
    return int(text)


def fix_threads(count: int | None = None) -> None:
    """Fix the number of threads before JAX is imported, so that XLA takes it too."""
    os.environ["NPROC"] = str(count or threads())


@contextmanager
def stopping(stop: Callable[[], object]) -> Generator[list[int]]:
    """Let the first signal call `stop`, for a clean end, and the second end the process.

    Yields the list of signals received so far.
    """
    received: list[int] = []

    def handle(number: int, frame: FrameType | None) -> None:
        if received:
            os._exit(128 + number)
        received.append(number)
        stop()

    watched = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1)
    before = {number: signal.signal(number, handle) for number in watched}
    try:
        yield received
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def exit_code(received: list[int]) -> int:
    """The code of a command that saved and ended on a signal: 130 after Ctrl-C, else 143."""
    return 130 if received[0] == signal.SIGINT else 143
