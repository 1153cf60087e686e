"""Forks crowds: a line of [words, seconds] makes one process of the command for each of seconds.

It has imported everything before it forks, so that sixteen processes are no long wait.
"""

import json
import os
import signal
import sys
import time

import pacesetter.training.trainer  # noqa: F401 (imports what a command does)
from pacesetter.cli.main import main

PATIENCE = 300  # seconds
TRACEBACK = 99  # the exit code that stands for one


def serve() -> None:
    """Answer each line with the exit codes."""
    for line in sys.stdin:
        words, waits = json.loads(line)
        start = time.monotonic() + 0.1
        crowd = [_fork(words, start + wait) for wait in waits]
        codes = [os.waitstatus_to_exitcode(os.waitpid(each, 0)[1]) for each in crowd]
        print(json.dumps(codes), flush=True)


def _fork(words: list[str], moment: float) -> int:
    if process := os.fork():
        return process
    code = TRACEBACK
    try:
        signal.alarm(PATIENCE)
        nothing = os.open(os.devnull, os.O_RDWR)
        for stream in (0, 1, 2):
            os.dup2(nothing, stream)
        time.sleep(max(0.0, moment - time.monotonic()))
        code = main(words)
    finally:
        os._exit(code)


if __name__ == "__main__":
    serve()
