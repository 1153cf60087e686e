"""Whatever a task's code does to end the process, the process ends as it wants to."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import pytest
from stopping import raiser

from pacesetter.envs.calls import call
from pacesetter.errors import TaskError
from pacesetter.process import Interrupted, interrupt, stopping


@pytest.mark.parametrize(
    ("function", "told"),
    [
        (lambda: sys.exit(0), "SystemExit: 0"),
        (lambda: os._exit(0), "SystemExit: os._exit(0)"),
        (raiser(KeyboardInterrupt("of its own")), "KeyboardInterrupt: of its own"),
        (raiser(GeneratorExit("early")), "GeneratorExit: early"),
        (raiser(MemoryError("no room")), "MemoryError: no room"),
        (raiser(BrokenPipeError(32, "Broken pipe")), "BrokenPipeError: [Errno 32] Broken pipe"),
    ],
)
def test_whatever_it_raises_is_its_fault(function: Callable[[], Any], told: str) -> None:
    before = os._exit
    with stopping(lambda: None), pytest.raises(TaskError) as fault:
        call("Robot-v0: step: failed", None, function)
    assert str(fault.value) == f"Robot-v0: step: failed: {told}"
    assert os._exit is before


@pytest.mark.parametrize(
    ("handler", "raised"),
    [(signal.default_int_handler, KeyboardInterrupt), (interrupt, Interrupted)],
)
def test_a_signal_is_nobodys_fault(handler: Any, raised: type[BaseException]) -> None:
    """In Python and in commands that end by an exception, Ctrl-C within a step is Ctrl-C."""
    before = signal.signal(signal.SIGINT, handler)
    try:
        with pytest.raises(raised):
            call("step", None, lambda: signal.raise_signal(signal.SIGINT))
        if handler is interrupt:  # and a task's own is still the task's
            with pytest.raises(TaskError):
                call("step", None, raiser(KeyboardInterrupt()))
    finally:
        signal.signal(signal.SIGINT, before)


FORKS = """
import os
from pacesetter.envs.calls import call

def forks():
    if os.fork() == 0:
        os._exit(7)
    return os.waitstatus_to_exitcode(os.wait()[1])

print(call("step", None, forks))
"""


def test_a_child_of_the_task_exits_as_it_likes() -> None:
    done = subprocess.run([sys.executable, "-c", FORKS], capture_output=True, text=True, timeout=60)
    assert (done.stdout, done.stderr) == ("7\n", "")


# Limits of time.


def stubborn() -> None:
    """Hangs, and catches whatever it can."""
    while True:
        with suppress(Exception):
            time.sleep(60)


def test_a_call_that_hangs_is_woken() -> None:
    before = time.monotonic()
    with pytest.raises(TaskError) as fault:
        call("Robot-v0: step: failed", 0.6, stubborn)
    assert time.monotonic() - before < 30  # a nap lasts 60, and so many minutes 36
    assert str(fault.value) == (
        "Robot-v0: step: failed: it has not returned after 0.6 s, the limit of --env-timeout"
    )


def test_a_call_within_its_time_is_left_alone() -> None:
    """And nothing comes after it."""
    assert call("step", 0.2, lambda: 7) == 7
    time.sleep(0.3)


HANGS_IN_C = """
import ctypes
from pacesetter.envs import limits
from pacesetter.envs.calls import call

limits.GRACE = 0.5
mutex = (ctypes.c_char * 64)()
library = ctypes.CDLL(None)
library.pthread_mutex_lock(mutex)
call("Robot-v0: step: failed", 0.2, library.pthread_mutex_lock, mutex)
"""


def test_a_call_that_hangs_in_c_ends_the_process() -> None:
    words = [sys.executable, "-c", HANGS_IN_C]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr == (
        "pacesetter: stopped: Robot-v0: step: failed: "
        "it has not returned after 0.2 s and cannot be woken\n"
    )


def test_limits_within_limits() -> None:
    """The earlier end counts, and the outer one is there again when the inner has ended."""

    def outer(inner: float) -> None:
        call("reset", inner, lambda: 7)
        stubborn()

    for inner in (0.1, 60.0):
        with pytest.raises(TaskError, match=r"renewal: .*0.3 s"):
            call("renewal", 0.3, outer, inner)
    with pytest.raises(TaskError, match=r"renewal: "):
        call("renewal", 0.3, lambda: call("reset", 60.0, stubborn))


OTHER_THREAD_FIRST = """
import threading, time
from pacesetter.envs.limits import Overdue, limited

def wait(seconds):
    with limited(seconds, "call"):
        time.sleep(0.1)

thread = threading.Thread(target=wait, args=[60])
thread.start()
thread.join()
try:
    with limited(0.2, "call"):
        time.sleep(60)
except Overdue:
    print("woken")
"""


def test_a_call_is_woken_whichever_thread_had_the_first() -> None:
    words = [sys.executable, "-c", OTHER_THREAD_FIRST]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60)
    assert (done.stdout, done.stderr, done.returncode) == ("woken\n", "", 0)


HANGS_BESIDE = """
import threading, time
from pacesetter.envs import limits

limits.GRACE = 0.5

def hang():
    with limits.limited(0.3, "hung"):
        time.sleep(60)

threading.Thread(target=hang, daemon=True).start()
for _ in range(100):
    with limits.limited(60, "quick"):
        time.sleep(0.05)
"""


def test_a_quick_call_lifts_no_limit_of_another_thread() -> None:
    words = [sys.executable, "-c", HANGS_BESIDE]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60)
    assert done.returncode == 1
    assert done.stderr.startswith("pacesetter: stopped: hung: it has not returned after 0.3 s")
