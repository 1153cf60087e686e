"""Experiment: one seed is one run, however busy the machine is; other threads are told."""

import os
import random
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from attempts import Tally
from short_runs import assert_same
from stopping import PATIENCE, only_run

from pacesetter.runs import RunDirectory

THREADS = 2
OTHERS = (1, 3, 4)
HALF, WHOLE = "1000", "1500"  # a run that ends logs how training went, others each 1,000 steps
WORDS = "train multi-td3 Hopper-v5 --hidden 128 128 --batch-size 128 --warmup 100 -q"
WORDS += " --eval-every 500 --eval-episodes 1 --checkpoint-every 0.5s"
EACH = 6  # trials, of which the last is of another number of threads
MOST = 4  # processes of the load
LOAD = """
import random, time
rng = random.Random({seed})
while True:
    end = time.monotonic() + rng.uniform(0, 0.3)
    while time.monotonic() < end:
        sum(range(1000))
    time.sleep(rng.uniform(0, 0.3))
"""
RESUME = """
import sys
from pacesetter import Trainer
trainer = Trainer.resume(sys.argv[1], steps={steps})
print(*trainer.notes, sep="\\n", file=sys.stderr)
for _ in trainer:
    pass
"""


def run(folder: Path, count: int, seed: int = 0) -> Tally:
    """So many runs of one seed, most under a random load; some of another number of threads."""
    rng, tally = random.Random(seed), Tally()
    _train(folder / "first", THREADS, WHOLE)
    first = only_run(folder / "first")
    ways = (_other_threads, _resumed_by_command, _resumed_in_python)
    for number in range(count):
        runs = folder / str(number)
        other = number % EACH == EACH - 1
        try:
            with load(rng):
                if other:
                    threads = OTHERS[number // EACH % len(OTHERS)]
                    said = ways[number // EACH % len(ways)](runs, threads)
                else:
                    said = _train(runs, THREADS, WHOLE)
            _check_same(first, only_run(runs), said)
        except AssertionError as error:
            tally.wrong.append(f"{number}: {error!s:.300}")
        tally.made += 1
    return tally


def _check_same(first: RunDirectory, other: RunDirectory, said: str) -> None:
    try:
        assert_same(first, other)
    except AssertionError:
        if "threads" not in said:
            raise


def told(tally: Tally) -> str:
    """As the table tells it."""
    others = tally.made // EACH
    return (
        f"{tally.made - others} runs under load and {others} of other threads: "
        f"{len(tally.wrong)} that differ without a word"
    )


@contextmanager
def load(rng: random.Random) -> Iterator[None]:
    """Some processes that compute now and then."""
    programs = [LOAD.format(seed=rng.random()) for _ in range(rng.randrange(MOST + 1))]
    busy = [subprocess.Popen([sys.executable, "-c", program]) for program in programs]
    try:
        yield
    finally:
        for process in busy:
            process.send_signal(signal.SIGKILL)
            process.wait()


def _run(words: list[str], threads: int) -> str:
    done = subprocess.run(
        [sys.executable, *words],
        capture_output=True,
        text=True,
        env=os.environ | {"NPROC": str(threads)},
        timeout=PATIENCE,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stderr


def _train(runs: Path, threads: int, steps: str) -> str:
    words = ["-m", "pacesetter", *WORDS.split(), "--steps", steps, "--runs", str(runs)]
    return _run(words, threads)


def _other_threads(runs: Path, threads: int) -> str:
    """A run of its own: its config names the threads, and so does `compare`."""
    said = _train(runs, threads, WHOLE)
    recorded: Any = only_run(runs).record()["threads"]
    return f"{said} {recorded} threads" if recorded == threads else said


def _half(runs: Path) -> RunDirectory:
    _train(runs, THREADS, HALF)
    return only_run(runs)


def _resumed_by_command(runs: Path, threads: int) -> str:
    """Which takes the number of threads from the run, so that nothing need be said."""
    said = _run(
        ["-m", "pacesetter", "resume", str(_half(runs).path), "--steps", WHOLE, "-q"], threads
    )
    assert "threads" not in said, said
    return said


def _resumed_in_python(runs: Path, threads: int) -> str:
    """Where the threads are what they are."""
    said = _run(["-c", RESUME.format(steps=WHOLE), str(_half(runs).path)], threads)
    assert f"made with {THREADS} threads, going on with {threads}" in said, said
    return said
