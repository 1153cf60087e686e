"""The command, from its first instruction to its exit code; it imports what is heavy last."""

import os
import sys

from pacesetter.cli.streams import UNREAD, guard
from pacesetter.process import hold_exit, interrupt, leave, on_signals


def main() -> int:
    """Run the command that the process was started with. Returns its exit code."""
    on_signals(leave)
    done, code = hold_exit(), 1
    try:
        code = _command()
    finally:  # from here on C must not call Python
        done(code)
    return code


def _command() -> int:
    answer = guard()
    from pacesetter.cli.main import main as command

    on_signals(interrupt)
    try:
        code = command()
    except SystemExit as end:  # argparse after --help
        code = int(end.code or 0)
    sys.stdout.flush()
    if code == 0 and answer.lost:
        code = UNREAD
    on_signals(lambda number, frame: os._exit(code))  # the work is done and its end is said
    return code


if __name__ == "__main__":
    sys.exit(main())
