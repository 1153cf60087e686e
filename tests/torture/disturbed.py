"""Commands that a signal reaches while they train: a program of its own, given its plan as JSON.

Each part of the plan is a command, a signal, the tick from which it may come, and a delay.
"""

import json
import os
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1] / "helpers"))


def signal_from(tick: int, number: int, delay: float) -> None:
    """Let the signal come to this process so many seconds after a trainer begins that tick."""
    from pacesetter.training.trainer import Trainer

    train = Trainer.__iter__

    def train_and_wait(self: Trainer) -> Iterator[Any]:
        once, sent = self.loop.tick, False

        def tick_and_send() -> Any:
            nonlocal sent
            if not sent and self.progress.tick >= tick:
                sent = True
                threading.Timer(delay, os.kill, (os.getpid(), number)).start()
            return once()

        self.loop.tick = tick_and_send
        Trainer.__iter__ = train
        return train(self)

    Trainer.__iter__ = train_and_wait


def main() -> None:
    """Run the commands of the plan; print the exit code of each."""
    from stopping import RING

    from pacesetter.cli.main import main as command
    from pacesetter.replay import buffer

    vars(buffer).update(RING)
    for words, number, tick, delay in json.loads(sys.argv[1]):
        signal_from(tick, number, delay)
        print(f"ended with {command(words)}", flush=True)


if __name__ == "__main__":
    main()
