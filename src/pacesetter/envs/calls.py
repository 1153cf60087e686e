"""Calls into a task's code: however it fails or exits, that is a fault of the task."""

import os
from collections.abc import Callable
from typing import Any, NoReturn

from pacesetter.envs.limits import Overdue, limited
from pacesetter.errors import TaskError, reason
from pacesetter.process import is_signal

_exit = os._exit


def call(
    failed: str, limit: float | None, function: Callable[..., Any], *given: Any, **named: Any
) -> Any:
    """What a function of the task's code gives. Raises TaskError for whatever it raises.

    That includes SystemExit, `os._exit`, and KeyboardInterrupt unless a signal raised it. What
    exits without Python, as a simulator in C may, cannot be held. `limit` is how many seconds it
    may take.
    """
    process = os.getpid()

    def refuse(status: int) -> NoReturn:
        if os.getpid() != process:  # a child that the task has forked
            _exit(status)
        raise SystemExit(f"os._exit({status})")

    os._exit = refuse
    try:
        if limit is None:
            return function(*given, **named)
        with limited(limit, failed):
            return function(*given, **named)
    except Overdue:
        late = f"it has not returned after {limit:g} s, the limit of --env-timeout"
        raise TaskError(f"{failed}: {late}") from None
    except BaseException as error:
        if is_signal(error):
            raise
        raise TaskError(f"{failed}: {reason(error)}") from error
    finally:
        os._exit = _exit
