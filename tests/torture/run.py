"""Run the experiments and write what came out into the table of docs/reliability.md.

`python tests/torture/run.py` takes minutes, with `--long` hours; `make torture` calls it. Names
of experiments run these alone, and the other rows of the table stay. Each is a process of its own.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "tests" / "helpers"))

import configurations  # noqa: E402
import crowds  # noqa: E402
import disk_full  # noqa: E402
import exactness  # noqa: E402
import faults  # noqa: E402
import memory  # noqa: E402
import odd_files  # noqa: E402
import page  # noqa: E402
import power_cuts  # noqa: E402
import processes  # noqa: E402
import rude  # noqa: E402
import sameness  # noqa: E402
import swapped  # noqa: E402
from attempts import Tally  # noqa: E402

PAGE = ROOT / "docs" / "reliability.md"


class Experiment(NamedTuple):
    """What is done, what must come out, and how often it is done in short and at length."""

    name: str
    what: str
    target: str
    make: Callable[[Path, int], Tally]
    short: int
    long: int
    told: Callable[[Tally], str] = Tally.table


def _odd(folder: Path, size: int) -> Tally:
    return odd_files.run(folder, odd_files.KINDS, size // len(odd_files.KINDS))


TARGET = "0 tracebacks, 0 code run, under 100 MB and 1 CPU second each"
EXPERIMENTS = (
    Experiment(
        "configurations",
        "configurations made at random",
        TARGET,
        configurations.run,
        1_000,
        10_000,
    ),
    Experiment(
        "files", "files of eight kinds with one odd thing each", TARGET, _odd, 1_600, 10_000
    ),
    Experiment(
        "swaps",
        "a run's files cut, flipped, emptied, swapped, or a folder, a link, a FIFO",
        "a whole checkpoint is taken up, or one line; " + TARGET,
        swapped.run,
        100,
        300,
    ),
    Experiment(
        "kills",
        "SIGKILL at random moments: four learners, checkpoints twice a second",
        "every checkpoint whole, no step lost beyond the last; ends as if undisturbed; no litter",
        processes.kills,
        10,
        200,
        Tally.of_processes,
    ),
    Experiment(
        "signals",
        "INT, TERM, HUP, USR1 at random moments, start-up included",
        "saved once there is something to save, gone in 10 s, the code of the signal",
        processes.signals,
        12,
        200,
        processes.signals_told,
    ),
    Experiment(
        "rude",
        "tasks that raise, exit, crash, hang or print, in Python or C, in `train` and in `bench`",
        "no orphan, no false success; one line unless killed; a run beside it ends well",
        rude.run,
        6,
        26,
        rude.told,
    ),
    Experiment(
        "one-seed",
        "one seed under a random load, and on other numbers of threads, new or resumed",
        "the same run, bit for bit; where threads change bits, config.json or a line says so",
        sameness.run,
        6,
        24,
        sameness.told,
    ),
    Experiment(
        "memory",
        "thousands of steps after the replay is full; many trainings in one process",
        "under 1 MB more in 100,000 steps; within 5% of the memory after the first trainings",
        memory.run,
        20,
        200,
        memory.told,
    ),
    Experiment(
        "faults",
        "NaN, infinity or 1e38 as observation, reward, action, loss, weight or moment",
        "found within 100 calls of an update, named by place, member and step; in no file",
        faults.run,
        54,
        162,
        Tally.of_processes,
    ),
    Experiment(
        "crowds",
        "16 processes train one new name, then two resume it; two benches for every tenth name",
        "one has it, the others are refused; the run is as one process alone makes it",
        crowds.run,
        10,
        100,
        Tally.of_processes,
    ),
    Experiment(
        "disk-full",
        "a disk that is full at the start, in training or at a checkpoint, at random sizes",
        "no checkpoint lost, no litter; one line says it; with room it ends as if undisturbed",
        disk_full.run,
        12,
        50,
        Tally.of_processes,
    ),
    Experiment(
        "exact",
        "stopped, killed and resumed at 10 random points of a run: all algorithms, four tasks",
        "weights, replay, streams and log as those of the run that nobody disturbed, bit for bit",
        exactness.run,
        22,
        88,
        exactness.told,
    ),
    Experiment(
        "power-cuts",
        "power cuts between operations on files: what was not synced is lost, or a random part",
        "the newest finished checkpoint, log and policies whole; ends as if undisturbed",
        power_cuts.run,
        20,
        100,
        Tally.of_processes,
    ),
)


def main() -> int:
    """Exit code 1 if a target was missed."""
    command = argparse.ArgumentParser(description=__doc__)
    names = [each.name for each in EXPERIMENTS]
    command.add_argument("names", nargs="*", metavar="NAME", help=f"one of {', '.join(names)}")
    command.add_argument("--long", action="store_true", help="the sizes of the targets")
    size = "another size, of the one experiment that is named"
    command.add_argument("--size", type=int, metavar="N", help=size)
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1
    jobs = "experiments at once (default one per core)"
    command.add_argument("--jobs", type=int, default=cores, metavar="N", help=jobs)
    given = command.parse_args()
    if unknown := {*given.names} - {*names}:
        command.error(f"no experiment has the name {min(unknown)}")
    if given.size is not None and (len(given.names) != 1 or given.size < 1):
        command.error("--size must be at least 1, and goes with one NAME")
    if len(given.names) == 1:
        (each,) = (each for each in EXPERIMENTS if each.name in given.names)
        count = given.size or (each.long if given.long else each.short)
        return 0 if _run(each, count) else 1
    with ThreadPoolExecutor(given.jobs) as pool:
        codes = [*pool.map(partial(_in_its_own, long=given.long), given.names or names)]
    return 1 if any(codes) else 0


def _in_its_own(name: str, long: bool) -> int:
    words = [sys.executable, __file__, name, *(["--long"] if long else [])]
    done = subprocess.run(words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    print(done.stdout, end="", flush=True)
    return done.returncode


def _run(each: Experiment, size: int) -> bool:
    """Make one experiment, print its faults and write its row; whether its target was met."""
    warnings.simplefilter("ignore")
    with tempfile.TemporaryDirectory() as folder:
        tally = each.make(Path(folder), size)
    told = each.told(tally)
    print(f"{each.what}: {told}", *tally.wrong[:20], sep="\n  ", flush=True)
    new = page.row(each.what, each.target, told, tally.passed)
    page.write(PAGE, new, [other.what for other in EXPERIMENTS])
    return tally.passed


if __name__ == "__main__":
    sys.exit(main())
