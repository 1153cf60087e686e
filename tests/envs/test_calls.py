"""Whatever a task's code does to end the process, the process ends as it wants to."""

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import pytest

from pacesetter.envs.calls import call
from pacesetter.errors import TaskError
from pacesetter.process import Interrupted, interrupt, stopping


def raiser(error: BaseException) -> Callable[[], Any]:
    def function() -> None:
        raise error

    return function


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
        call("Robot-v0: step: failed", function)
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
            call("step", lambda: signal.raise_signal(signal.SIGINT))
        if handler is interrupt:  # and a task's own is still the task's
            with pytest.raises(TaskError):
                call("step", raiser(KeyboardInterrupt()))
    finally:
        signal.signal(signal.SIGINT, before)


FORKS = """
import os
from pacesetter.envs.calls import call

def forks():
    if os.fork() == 0:
        os._exit(7)
    return os.waitstatus_to_exitcode(os.wait()[1])

print(call("step", forks))
"""


def test_a_child_of_the_task_exits_as_it_likes() -> None:
    done = subprocess.run([sys.executable, "-c", FORKS], capture_output=True, text=True, timeout=60)
    assert (done.stdout, done.stderr) == ("7\n", "")
