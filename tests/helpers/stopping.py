"""Runs that are stopped or killed, in this process or in one of their own."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from short_runs import run_to_end

from pacesetter import files, storage
from pacesetter.runs import RunDirectory, find_all
from pacesetter.training.trainer import Trainer

# The ring in small, so that it goes round several times within one short run.
RING = {"BLOCK": 64, "UNCOMMITTED": 150, "SLACK": 364}
COMMAND = f"""
import sys
from pacesetter.replay import buffer
vars(buffer).update({RING})
from pacesetter.cli.main import main
sys.exit(main())
"""
PATIENCE = 120


def stop_at(trainer: Trainer, tick: int) -> None:
    """Run until a tick has passed, then end as a signal would."""
    once = trainer.loop.tick

    def tick_and_stop() -> object:
        selection = once()
        if trainer.progress.tick >= tick:
            trainer.stop()
        return selection

    trainer.loop.tick = tick_and_stop
    run_to_end(trainer)


def launch(words: list[str], runs: Path, *program: str) -> subprocess.Popen[str]:
    """A command as a process of its own, with the small ring unless a program is given."""
    command = [sys.executable, *(program or ("-c", COMMAND)), *words, "--runs", str(runs)]
    pipes: Any = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    # Background jobs of some shells ignore SIGINT, and children inherit that.
    return subprocess.Popen(command, **pipes, text=True, env=dict(os.environ))


def wait_for(what: Callable[[], object], process: subprocess.Popen[str]) -> None:
    """Until `what` is true while the process runs."""
    end = time.monotonic() + PATIENCE
    while not what():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < end
        time.sleep(0.005)


def raiser(error: BaseException) -> Callable[..., Any]:
    """A function that raises this error."""

    def function(*_: object) -> None:
        raise error

    return function


def only_run(runs: Path) -> RunDirectory:
    """The only run below a folder."""
    (config,) = runs.rglob("config.json")
    return RunDirectory(config.parent)


def litter(directory: RunDirectory) -> list[Path]:
    """What half-written files a run has left."""
    return list(directory.path.rglob(f"*{files.TEMPORARY}"))


def saved_step(directory: RunDirectory) -> int:
    """Step of the newest checkpoint; reading it fails if it is not whole."""
    progress = storage.read(directory.state_file, "checkpoint").table["progress"]
    return sum(member["steps"] for member in progress["members"]) + progress["selection_steps"]


def training(runs: Path) -> bool:
    """Whether the only run below a folder has a checkpoint and a process that goes on with it."""
    return any(run.in_use() and run.state_file.exists() for run in find_all(runs))


def has_saved_beyond(directory: RunDirectory, step: int) -> bool:
    """Whether there is a checkpoint later than a step."""
    return saved_step(directory) > step


def kill_and_resume(
    words: list[str],
    tmp_path: Path,
    kills: int,
    seed: int,
    program: tuple[str, ...] = (),
    more: int | None = None,
) -> RunDirectory:
    """Kill a run many times, most of them after it has saved something new; then let it end.

    `more` is how many steps it makes after the last kill, by default all of its budget.
    """
    rng = np.random.default_rng(seed)
    runs, saved = tmp_path / "killed", 0
    for number in range(kills):
        process = launch(words, runs, *program)
        wait_for(partial(training, runs), process)
        directory = only_run(runs)
        words = ["resume", str(directory.path)]
        if number % 3:  # the others die wherever they are, early ones before the first save
            wait_for(partial(has_saved_beyond, directory, saved), process)
        time.sleep(float(rng.uniform(0, 0.6)))
        process.kill()
        process.communicate(timeout=PATIENCE)
        assert process.returncode == -signal.SIGKILL
        assert not directory.in_use()
        step = saved_step(directory)
        assert step > saved if number % 3 else step >= saved
        saved = step
    trainer = Trainer.resume(directory.path, steps=more and saved + more)
    assert trainer.notes == []
    assert trainer.progress.step == saved > 0
    assert litter(directory) == []
    run_to_end(trainer)
    assert trainer.finished
    assert not directory.in_use()
    assert litter(directory) == []
    return directory
