"""Run the commands of a bench on this machine's cores or on a Ray cluster, or print them."""

import os
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Generator, Iterable
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from pacesetter.errors import UsageError
from pacesetter.extras import need
from pacesetter.files import make_folder
from pacesetter.process import CODES, cores
from pacesetter.runs.lock import Lock
from pacesetter.study.bench.queue import ALONE, Outcome
from pacesetter.study.bench.suite import Job
from pacesetter.text import printable


class Local:
    """Processes on this machine, each pinned to one core, which gives the most runs per hour."""

    def __init__(self, slots: int) -> None:
        self.slots, self._cores = slots, cores()

    def start(self, slot: int, words: list[str]) -> Any:
        output = tempfile.TemporaryFile()  # noqa: SIM115, as `poll` closes it
        core, lock = _claim_core(self._cores, slot)
        with _pinned(core):
            return _popen(words, output), output, lock

    def poll(self, task: Any) -> Outcome | None:
        process, output, lock = task
        if process.poll() is None:
            return None
        _end(process)
        lock.free()
        output.seek(0)
        with output:
            return Outcome(process.returncode, output.read().decode(errors="replace"))

    def stop(self, task: Any) -> None:
        task[0].terminate()

    def kill(self, task: Any) -> None:
        _end(task[0])


class Ray:
    """Tasks of a Ray cluster; each only runs a command, in this folder, which all nodes share."""

    def __init__(self, slots: int | None, address: str | None) -> None:
        self._ray = ray = need("executor", "ray", "pacesetter[scale]")
        try:
            ray.init(address=address, log_to_driver=False, ignore_reinit_error=True)
        except (ConnectionError, ValueError, RuntimeError) as error:
            raise UsageError(f"address: no Ray cluster at {address}: {error}") from None
        self.slots = slots or max(int(ray.cluster_resources().get("CPU", 1)), 1)
        self._run: Any = ray.remote(num_cpus=1, max_retries=0)(run_command)

    def start(self, slot: int, words: list[str]) -> Any:
        return self._run.remote(words, os.getcwd())

    def poll(self, task: Any) -> Outcome | None:
        if not self._ray.wait([task], timeout=0)[0]:
            return None
        try:
            return Outcome(*self._ray.get(task))
        except self._ray.exceptions.TaskCancelledError:
            return Outcome(CODES[signal.SIGTERM], "")
        except self._ray.exceptions.RayError as error:  # its worker or its node is lost
            return Outcome(1, str(error))

    def stop(self, task: Any) -> None:
        self._ray.cancel(task)

    def kill(self, task: Any) -> None:
        self._ray.cancel(task, force=True)


def run_command(words: list[str], folder: str) -> tuple[int, str]:
    """Run `pacesetter WORDS` in a folder; save and end when Ray cancels the task."""
    # A cluster that was started in the background of a script ignores interrupts.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    with tempfile.TemporaryFile() as output:
        process = _popen(words, output, folder)
        try:
            while process.poll() is None:  # Ray cannot interrupt a wait
                time.sleep(0.2)
        except KeyboardInterrupt:
            process.terminate()
            process.wait()
        _end(process)
        output.seek(0)
        return process.returncode, output.read().decode(errors="replace")


def _popen(words: list[str], output: Any, folder: str | None = None) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, "-m", "pacesetter", *words],
        stdin=subprocess.DEVNULL,
        stdout=output,
        stderr=subprocess.STDOUT,
        env=os.environ | ALONE,
        cwd=folder,
        start_new_session=True,  # Ctrl-C reaches the bench alone, which passes it on once
    )


def _end(process: subprocess.Popen[bytes]) -> None:
    """End a command, if it runs, and all that it started: a crash leaves a simulator's helpers."""
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)


def _claim_core(cores: list[int], slot: int) -> tuple[int, Lock]:
    """A core to which no bench of this user has pinned a run, and its lock, held.

    Where all are taken, the core that the slot comes to, which is then shared. A killed bench holds
    none, though its runs may go on.
    """
    own = slot % len(cores)
    folder = Path(tempfile.gettempdir()) / f"pacesetter-cores-{os.getuid()}"
    for core in (*cores[own:], *cores[:own]):
        lock = Lock(folder / str(core))
        with suppress(UsageError, OSError):
            make_folder(folder)
            if not lock.is_held():
                lock.take()
                return core, lock
    return cores[own], Lock(folder / str(cores[own]))


@contextmanager
def _pinned(core: int) -> Generator[None]:
    """Pin processes started in here to one core from their first instruction, if it can be."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {core})
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


# Printed.


def commands(jobs: Iterable[Job]) -> list[str]:
    """One shell line per run, which starts it or, if its folder is there, resumes it."""
    alone = " ".join(f"{name}={value}" for name, value in ALONE.items())
    program = f"{alone} exec {shlex.quote(sys.executable)} -m pacesetter"
    lines: list[str] = []
    for job in jobs:
        resume = shlex.join(job.directory.resume_words(job.config))
        config = shlex.quote(str(job.directory.config_file))
        train, always = shlex.join(job.words), shlex.join([*job.always, "-q"])
        lines.append(
            f"if [ -e {config} ]; then {program} {resume} {always}; "
            f"else {program} {train} {always}; fi"
        )
    return lines


SLURM = """\
#!/bin/bash
#SBATCH --job-name={name}
#SBATCH --array=0-{last}
#SBATCH --cpus-per-task=1
#SBATCH --requeue
#SBATCH --signal=TERM@120
#SBATCH --open-mode=append
# sbatch --time=... --mem=... this file, in the folder where it was made; and again after a failure.
commands=(
{commands}
)
srun bash -c "${{commands[$SLURM_ARRAY_TASK_ID]}}"
code=$?
case $code in
129 | 130 | 143) scontrol requeue "${{SLURM_ARRAY_JOB_ID}}_$SLURM_ARRAY_TASK_ID" ;; # saved: go on
esac
exit $code
"""


def slurm(name: str, jobs: list[Job]) -> str:
    """A job array with one task per run; runs save when Slurm warns before the time limit."""
    lines = "\n".join(shlex.quote(line) for line in commands(jobs))
    quoted = shlex.quote(printable(name))
    return SLURM.format(name=quoted, last=len(jobs) - 1, commands=lines)
