"""Experiment: memory in a long run, and in a process that trains many times.

`python memory.py long 200000 0` and `python memory.py many 50 0` are its programs: each prints, as
JSON, megabytes of the process after steps, or after trainings.
"""

import json
import os
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

sys.path[:0] = [str(Path(__file__).parents[1] / "helpers")]

from attempts import Tally  # noqa: E402
from short_runs import TINY, run_to_end  # noqa: E402
from stopping import RING  # noqa: E402

FULL = 2_000  # steps after which the replay goes round
EVERY = 1_000  # steps between two looks
SLOPE = 1.0  # megabytes in 100,000 steps
FIRST = 3  # trainings before the one that the last is compared with
BACK = 0.05
PATIENCE = 3600


def run(folder: Path, count: int, leak: int = 0) -> Tally:
    """So many thousand steps after the replay is full, and a fourth as many trainings.

    A leak of some bytes a step is for the test of this experiment.
    """
    tally = Tally()
    slope = _slope(_told("long", count * 1_000, leak))
    many = _told("many", max(count // 4, FIRST + 2), 0)
    growth = many[-1][1] / many[FIRST][1] - 1
    tally.made, tally.values = count, {"slope": slope, "trainings": len(many), "growth": growth}
    if slope >= SLOPE:
        tally.wrong.append(f"{slope:.2f} MB more in 100,000 steps")
    if growth >= BACK:
        tally.wrong.append(f"{growth:.1%} more after {len(many)} trainings: {many}")
    return tally


def told(tally: Tally) -> str:
    """As the table tells it."""
    found = tally.values
    return (
        f"{found['slope']:+.2f} MB in 100,000 steps, over {tally.made},000 steps; "
        f"{found['growth']:+.1%} after {found['trainings']} trainings"
    )


def _slope(looks: list[list[float]]) -> float:
    """Megabytes in 100,000 steps, by least squares."""
    steps, megabytes = np.array(looks).T
    return float(np.polyfit(steps / 1e5, megabytes, 1)[0])


def _told(what: str, size: int, leak: int) -> Any:
    words = [sys.executable, __file__, what, str(size), str(leak)]
    alone: Any = {"env": os.environ | {"NPROC": "1"}, "timeout": PATIENCE, "check": False}
    done = subprocess.run(words, capture_output=True, text=True, **alone)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


# The programs.


def megabytes() -> float:
    """What this process holds in memory now."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / 2**20


def trainer(runs: Path, **settings: Any) -> Any:
    """A run of tiny networks, with checkpoints and evaluations as often as in a real one."""
    from pacesetter.training.trainer import Trainer

    given = {**TINY, "replay_size": 1_000, "eval_every": 5_000, "checkpoint_every": 5, **settings}
    return Trainer("td3", "Pendulum-v1", runs=runs, **given)


def long(runs: Path, steps: int, leak: int) -> list[tuple[float, float]]:
    """Steps and megabytes of one run, from the moment when its replay is full."""
    found: list[tuple[float, float]] = []
    leaked: list[bytes] = []
    one = trainer(runs, steps=FULL + steps)
    once = one.loop.tick

    def tick_and_look() -> Any:
        if leak:
            leaked.append(b"x" * leak)  # zeros would take no memory until they are read
        done = one.progress.step
        if done >= FULL and done % EVERY == 0:
            found.append((done, megabytes()))
        return once()

    one.loop.tick = tick_and_look
    run_to_end(one)
    return found


def many(runs: Path, count: int, leak: int) -> list[tuple[float, float]]:
    """Trainings and megabytes after each."""
    found: list[tuple[float, float]] = []
    for seed in range(count):
        run_to_end(trainer(runs, steps=300, seed=seed))
        found.append((seed + 1, megabytes()))
    return found


def main() -> None:
    """Run one of the programs."""
    from pacesetter.replay import buffer

    vars(buffer).update(RING)
    programs = {"long": long, "many": many}
    with TemporaryDirectory() as folder:
        found = programs[sys.argv[1]](Path(folder), int(sys.argv[2]), int(sys.argv[3]))
    print(json.dumps(found))


if __name__ == "__main__":
    main()
