"""A limit of time for a call into a task's code, which may hang in Python or in C."""

import os
import signal
import threading
from collections.abc import Generator
from contextlib import contextmanager
from functools import cache
from math import inf
from time import monotonic, sleep
from typing import Any

GRACE = 5.0  # seconds in which a call that was woken has to come back
AGAIN = 1.0  # seconds until a call that caught its waking is woken again
_exit = os._exit


class Overdue(BaseException):
    """Raised in the task's code, where `except Exception` does not catch it."""


class Watchdog(threading.Thread):
    """Ends the process, with one line, if a call stays in C, where no signal handler runs.

    One that holds Python's lock there holds this thread too, and cannot be ended from within.
    """

    def __init__(self) -> None:
        super().__init__(daemon=True, name="watchdog of the task")
        self.due, self.message = inf, ""

    def run(self) -> None:
        while True:
            if monotonic() > self.due:
                os.write(2, f"pacesetter: stopped: {self.message}\n".encode())
                _exit(1)
            sleep(GRACE / 10)


@cache
def _watchdog() -> Watchdog:
    def wake(number: int, frame: Any) -> None:
        if _watchdog().due < inf:  # else the call came back at the last moment
            raise Overdue

    found = Watchdog()
    found.start()
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGALRM, wake)
    return found


@contextmanager
def limited(seconds: float, what: str) -> Generator[None]:
    """Raise Overdue in a call of the main thread that takes longer; end the process if that does
    not wake it, or if the call is of another thread.
    """
    dog, wakes = _watchdog(), threading.current_thread() is threading.main_thread()
    dog.message = f"{what}: it has not returned after {seconds:g} s and cannot be woken"
    dog.due = monotonic() + seconds + GRACE
    if wakes:
        signal.setitimer(signal.ITIMER_REAL, seconds, AGAIN)
    try:
        yield
    finally:
        dog.due = inf
        if wakes:
            signal.setitimer(signal.ITIMER_REAL, 0)
