"""Experiment: many processes want one run: new ones of one name, resumes, benches."""

import json
import random
import subprocess
import sys
from contextlib import closing
from pathlib import Path
from typing import Any

from attempts import Tally, command
from short_runs import assert_same
from stopping import litter, only_run

from pacesetter.runs import RunDirectory, find_all

SIZES = ["--hidden", "4", "--batch-size", "8", "--warmup", "60", "--replay-size", "1000"]
SIZES += ["--eval-episodes", "1", "--eval-every", "100", "-q"]
TRAIN = ["train", "td3", "Pendulum-v1", "--steps", "150", *SIZES, "--runs"]
BENCH = ["bench", "--algos", "td3", "--envs", "Pendulum-v1", "--seeds", "2", "--steps", "150"]
BENCH += [*SIZES, "--jobs", "1", "--runs"]
MORE = "250"  # steps, to which a run is resumed
LATEST = 1.5  # seconds by which the last of a crowd comes
REFUSED = {2, 75}


def run(folder: Path, count: int, seed: int = 0, size: int = 16) -> Tally:
    """So many crowds of new runs, each followed by two resumes; two benches for every tenth."""
    tally = Tally()
    whole = _alone(folder / "whole")
    if count >= 10:
        command(*BENCH, folder / "bench")()
    with closing(Crowds(random.Random(seed), size)) as crowds:
        for number in range(count):
            tally.made += 1
            try:
                _one_name(folder / str(number), whole, crowds)
                if number % 10 == 9:
                    _two_benches(folder / f"benches-{number}", folder / "bench", crowds)
            except AssertionError as error:
                tally.wrong.append(f"crowd {number}: {error!s:.300}")
    return tally


def _alone(runs: Path) -> RunDirectory:
    """The run that a crowd must come to, made by one process after the other."""
    command(*TRAIN, runs)()
    run = only_run(runs)
    command("resume", run.path, "--steps", MORE, "-q")()
    return run


def _one_name(runs: Path, whole: RunDirectory, crowds: "Crowds") -> None:
    """Many new runs of one name, then two resumes; the second may come after the first's end."""
    codes = crowds.work([*TRAIN, str(runs)], crowds.size)
    assert codes.count(0) == 1, f"exit codes {codes}"
    assert {*codes} <= {0, *REFUSED}, f"exit codes {codes}"
    run = only_run(runs)
    codes = crowds.work(["resume", str(run.path), "--steps", MORE, "-q"], 2)
    assert 0 in codes, f"exit codes of resumes {codes}"
    assert {*codes} <= {0, 75}, f"exit codes of resumes {codes}"
    _check(whole, run)


def _two_benches(runs: Path, alone: Path, crowds: "Crowds") -> None:
    """Two benches of one folder, which share the work."""
    codes = crowds.work([*BENCH, str(runs)], 2)
    assert codes == [0, 0], f"exit codes of benches {codes}"
    for run in find_all(runs):
        _check(RunDirectory(alone / run.path.relative_to(runs)), run)
    assert len([*find_all(runs)]) == 2


def _check(whole: RunDirectory, run: RunDirectory) -> None:
    assert_same(whole, run)
    assert not run.in_use()
    assert not litter(run)


class Crowds:
    """A process that forks crowds."""

    def __init__(self, rng: random.Random, size: int) -> None:
        self.rng, self.size = rng, size
        command = [sys.executable, str(Path(__file__).with_name("crowd.py"))]
        pipes: Any = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
        self._process = subprocess.Popen(command, **pipes, text=True)

    def work(self, words: list[str], size: int) -> list[int]:
        """One command by many processes, at once or soon after each other; their exit codes."""
        latest = self.rng.choice([0.0, LATEST])
        waits = [self.rng.uniform(0, latest) for _ in range(size)]
        assert self._process.stdin
        assert self._process.stdout
        print(json.dumps([words, waits]), file=self._process.stdin, flush=True)
        return json.loads(self._process.stdout.readline())

    def close(self) -> None:
        """End the process, which ends with its input."""
        self._process.communicate()
