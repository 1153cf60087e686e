"""Tasks that end, hold or drown the process which they are in, each in its own way.

They are named `rude_envs:RudeWAY-v0` and are fine until the process has made a number of steps.
Each has a helper, a process of its own that `close` ends.
"""

import ctypes
import os
import subprocess
import sys
import time
from collections.abc import Callable
from itertools import count
from pathlib import Path
from typing import Any, ClassVar

import gymnasium
from broken_envs import Probe

STEPS = int(os.environ.get("RUDE_STEPS", "350"))  # of this process, before it becomes rude
CRY = "rude words"


def _raise() -> None:
    raise RuntimeError(CRY)


def _interrupt() -> None:
    raise KeyboardInterrupt(CRY)


def _hang() -> None:
    if mark := os.environ.get("RUDE_MARK"):
        Path(mark).touch()
    while True:
        time.sleep(1)


def _print() -> None:
    print(CRY)
    os.write(1, f"{CRY}\n".encode())
    ctypes.CDLL(None).puts(CRY.encode())
    subprocess.run(["echo", CRY], check=True)


WAYS: dict[str, Callable[[], Any]] = {
    "Raises": _raise,
    "Interrupts": _interrupt,
    "Exits": lambda: sys.exit(0),
    "ExitsAtOnce": lambda: os._exit(0),
    "ExitsInC": lambda: ctypes.CDLL(None).exit(0),
    "ExitsInCHoldingPython": lambda: ctypes.PyDLL(None).exit(0),
    "Segfaults": lambda: ctypes.memset(0, 0, 1),
    "Aborts": os.abort,
    "IsKilled": lambda: os.kill(os.getpid(), 9),
    "Hangs": _hang,
    "HangsInC": lambda: ctypes.CDLL(None).sleep(1000),
    "Prints": _print,
}


class Rude(Probe):
    """Its way is the name under which it is made."""

    made: ClassVar = count()
    steps: ClassVar = count()

    def __init__(self, way: str) -> None:
        super().__init__()
        self.way = way
        self.helper = subprocess.Popen(["sleep", "600"])

    def step(self, action: Any) -> Any:
        number = next(self.steps)
        if number == STEPS or (number > STEPS and self.way == "Prints"):
            WAYS[self.way]()
        return super().step(action)

    def close(self) -> None:
        self.helper.kill()
        self.helper.wait()


for _way in WAYS:
    gymnasium.register(f"Rude{_way}-v0", entry_point=f"{__name__}:Rude", kwargs={"way": _way})
