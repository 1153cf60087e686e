"""A limit of time for a call into a task's code, which may hang in Python or in C."""

import os
import signal
import threading
from collections.abc import Generator
from contextlib import contextmanager
from functools import cache
from math import inf
from time import monotonic, sleep
from typing import Any, NamedTuple

GRACE = 5.0  # seconds in which a call that was woken has to come back
AGAIN = 1.0  # seconds until a call that caught its waking is woken again
_exit = os._exit


class Overdue(BaseException):
    """Raised in the task's code, where `except Exception` does not catch it."""


class Call(NamedTuple):
    """When a call must have come back, and what to say if it cannot be woken."""

    due: float
    message: str


class Watchdog(threading.Thread):
    """Ends the process, with one line, if a call stays in C, where no signal handler runs.

    One that holds Python's lock there holds this thread too, and cannot be ended from within.
    """

    def __init__(self) -> None:
        super().__init__(daemon=True, name="watchdog of the task")
        self.calls: dict[threading.Thread, Call] = {}  # the innermost one of each thread

    def run(self) -> None:
        while True:
            for call in [*self.calls.values()]:
                if monotonic() > call.due + GRACE:
                    os.write(2, f"pacesetter: stopped: {call.message}\n".encode())
                    _exit(1)
            sleep(GRACE / 10)


@cache
def _watchdog() -> Watchdog:
    found = Watchdog()
    found.start()
    return found


def _wake(number: int, frame: Any) -> None:
    if threading.main_thread() in _watchdog().calls:  # else it came back at the last moment
        raise Overdue


@contextmanager
def limited(seconds: float, what: str) -> Generator[None]:
    """Raise Overdue in a call of the main thread that takes longer; end the process if that does
    not wake it, or if the call is of another thread. Within another such call, the earlier end
    counts.
    """
    calls, own = _watchdog().calls, threading.current_thread()
    wakes, around = own is threading.main_thread(), calls.get(own)
    message = f"{what}: it has not returned after {seconds:g} s and cannot be woken"
    call = Call(monotonic() + seconds, message)
    calls[own] = call if around is None or call.due < around.due else around
    if wakes:
        signal.signal(signal.SIGALRM, _wake)
        _wake_at(calls[own].due)
    try:
        yield
    finally:
        if around is None:
            del calls[own]
        else:
            calls[own] = around
        if wakes:
            _wake_at(inf if around is None else around.due)


def _wake_at(due: float) -> None:
    left = 0.0 if due == inf else max(due - monotonic(), 1e-6)
    signal.setitimer(signal.ITIMER_REAL, left, AGAIN if left else 0)
