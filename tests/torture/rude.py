"""Experiment: tasks that raise, exit, crash, hang or print, in train and in bench."""

import os
import random
import re
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryFile
from typing import NamedTuple

import rude_envs
from attempts import Tally
from stopping import litter

from pacesetter.cli.show import state
from pacesetter.runs import find_all

FLAGS = "--steps 1200 --hidden 8 --batch-size 8 --warmup 100 --no-renew-env --eval-episodes 1"
FLAGS += " --eval-every 600 --checkpoint-every 0.2s -q"
LIMIT = ["--env-timeout", "5s"]
WELL = "Pendulum-v1"  # runs beside the rude task in a bench
MARK = "RUDE_TRIAL"  # in the environment of every process of a trial
GONE = 10.0  # seconds after the command, by which no process of it is left
IN_ALL = 600  # seconds of a command, a bench of three attempts too
CRASHES = ("ExitsInC", "ExitsInCHoldingPython", "Segfaults", "Aborts", "IsKilled", "HangsInC")
TWO_SIGNALS = "Hangs, two signals"  # to one that has no limit of time
EVERY = [*rude_envs.WAYS, TWO_SIGNALS]


class Ended(NamedTuple):
    """How a command ended."""

    code: int
    out: str
    err: str


def run(folder: Path, count: int, seed: int = 0) -> Tally:
    """So many trials: each way in `train` and in `bench`, from a random step of the process on."""
    rng, tally = random.Random(seed), Tally()
    trials = [(way, verb) for way in EVERY for verb in ("train", "bench")]
    rng.shuffle(trials)
    for number in range(count):
        way, verb = trials[number % len(trials)]
        trial = Trial(way, verb, folder / str(number), rng.randrange(150, 400))
        fault = trial.fault()
        tally.made += 1
        if fault:
            tally.wrong.append(f"{verb} of {way}: {fault}")
    return tally


def told(tally: Tally) -> str:
    """As the table tells it."""
    orphans = sum("left running" in each for each in tally.wrong)
    lies = sum("claims" in each for each in tally.wrong)
    others = len(tally.wrong) - orphans - lies
    return (
        f"{tally.made} made, of {2 * len(EVERY)} kinds; {orphans} orphans, {lies} false successes, "
        f"{others} other faults"
    )


class Trial:
    """One command on a task that is rude in one way."""

    def __init__(self, way: str, verb: str, folder: Path, steps: int) -> None:
        self.way, self.verb, self.folder = way, verb, folder
        self.fine = way == "Prints"
        self.task = f"rude_envs:Rude{'Hangs' if way == TWO_SIGNALS else way}-v0"
        here = str(Path(rude_envs.__file__).parent)
        self.mark = folder.with_name(f"{folder.name}-hangs")
        self.environ = os.environ | {
            MARK: str(folder),
            "RUDE_STEPS": str(steps),
            "RUDE_MARK": str(self.mark),
            "PYTHONPATH": here,
        }

    def fault(self) -> str:
        """What is wrong with how it ended; empty if nothing is."""
        try:
            ended = self._command()
        except subprocess.TimeoutExpired:
            return f"not gone in time; {len(self._left())} left running"
        finally:
            left = self._wait()
            for process in left:
                with suppress(ProcessLookupError):
                    os.kill(process, signal.SIGKILL)
        if "Traceback" in ended.err:
            return f"traceback: {ended.err[-300:]!r}"
        # The helpers of a crash in `train` have nobody left who could end them.
        if left and not (self.verb == "train" and self.way in (*CRASHES, TWO_SIGNALS)):
            return f"{len(left)} processes are left running"
        return self._answer(ended) or self._files()

    def _command(self) -> Ended:
        limit = [] if self.way == TWO_SIGNALS else LIMIT
        own = [*FLAGS.split(), *limit, "--runs", str(self.folder)]
        words = ["train", "td3", self.task, *own]
        if self.verb == "bench":
            words = ["bench", "--algos", "td3", "--envs", self.task, WELL, "--jobs", "2", *own]
        # Files, since helpers that outlive a crash would hold pipes open.
        with TemporaryFile() as out, TemporaryFile() as err:
            command = [sys.executable, "-m", "pacesetter", *words]
            process = subprocess.Popen(command, stdout=out, stderr=err, env=self.environ)
            try:
                if self.way == TWO_SIGNALS:
                    self._two_signals(process)
                process.wait(IN_ALL)
            finally:
                process.kill()
            found: list[str] = []
            for file in (out, err):
                file.seek(0)
                found.append(file.read().decode(errors="replace"))
        return Ended(process.returncode, *found)

    def _two_signals(self, process: "subprocess.Popen[bytes]") -> None:
        """Once the task hangs, the second while the first still waits for it."""
        end = time.monotonic() + IN_ALL
        while not self.mark.exists():
            if time.monotonic() > end or process.poll() is not None:
                raise subprocess.TimeoutExpired("train", IN_ALL)
            time.sleep(0.1)
        process.send_signal(signal.SIGINT)
        time.sleep(1)
        if process.poll() is None:
            process.send_signal(signal.SIGINT)

    def _answer(self, ended: Ended) -> str:
        """What the exit code and the words claim."""
        if rude_envs.CRY in ended.out:
            return "what the task prints is in the answer"
        if self.fine:
            return "" if ended.code == 0 else f"exit {ended.code}: {ended.err[-200:]!r}"
        if ended.code == 0:
            return f"claims success: {ended.out[-200:]!r}"
        if self.verb == "bench" and self.way != TWO_SIGNALS:
            said = re.search(r"(\d) of 2 runs finished.*; (\d) failed", ended.out)
            if not said or said.groups() != ("1", "1"):
                return f"claims {ended.out!r} {ended.err[-200:]!r}"
        elif self.verb == "train" and self.way not in ("Segfaults", "Aborts", "IsKilled"):
            silent = self.way == TWO_SIGNALS
            lines = [line for line in ended.err.splitlines() if line.startswith("pacesetter: stop")]
            if len(lines) != (0 if silent else 1) or ended.out:
                return f"not one line: {ended.err[-300:]!r} {ended.out!r}"
        return ""

    def _files(self) -> str:
        """What the runs' folders claim."""
        for run in find_all(self.folder):
            claimed = state(run)["state"]
            right = "finished" if self.fine or WELL in str(run.path) else "stopped"
            if claimed != right and self.way != TWO_SIGNALS:
                return f"{run.path.parts[-3]} claims to be {claimed}"
            if run.in_use() or (litter(run) and self.way not in CRASHES):
                return "a lock or litter is left"
        return ""

    def _wait(self) -> list[int]:
        """Processes of this trial that are there after some seconds.

        One that was killed has no environment any more when the system comes to close its files.
        """
        end = time.monotonic() + GONE
        while ((left := self._left()) or self._holds_a_run()) and time.monotonic() < end:
            time.sleep(0.1)
        return left

    def _holds_a_run(self) -> bool:
        return any(run.in_use() for run in find_all(self.folder))

    def _left(self) -> list[int]:
        mark = f"{MARK}={self.folder}".encode()
        found: list[int] = []
        for process in Path("/proc").glob("[0-9]*"):
            with suppress(OSError):
                environ = (process / "environ").read_bytes().split(b"\0")
                if mark in environ:
                    found.append(int(process.name))
        return found
