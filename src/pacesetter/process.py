"""What a command settles for its process: the number of threads, and how signals end it."""

import os
import signal
from collections.abc import Callable, Generator
from contextlib import contextmanager
from types import FrameType


def fix_threads(count: int | None = None) -> None:
    """Fix the size of XLA's thread pool, which decides result bits, before JAX is imported."""
    if count is not None:
        os.environ["NPROC"] = str(count)
    os.environ.setdefault("NPROC", str(len(os.sched_getaffinity(0))))


def threads() -> int:
    """How many threads this process may keep busy."""
    cores = len(os.sched_getaffinity(0))
    return max(int(os.environ.get("NPROC", cores)), 1)


@contextmanager
def stopping(stop: Callable[[], object]) -> Generator[list[int]]:
    """The first signal calls `stop`, which lets all end cleanly; the second ends the process.

    Gives the signals received so far.
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
    """130 after Ctrl-C, 143 after another request: all is saved, and the command goes on."""
    return 130 if received[0] == signal.SIGINT else 143
