"""Experiment: a disk so small that it fills at the start, at a checkpoint, or not quite.

The disk is a file system in memory. Who may not mount one gets a limit on the size of each file.
"""

import random
import resource
import subprocess
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from attempts import Tally, command, patched
from short_runs import assert_same
from stopping import RING, litter, only_run

from pacesetter import storage
from pacesetter.errors import UsageError
from pacesetter.replay import buffer
from pacesetter.runs import RunDirectory
from pacesetter.training import checkpoint

WORDS = ["train", "multi-td3", "Pendulum-v1", "--members", "2", "--steps", "600", "-q"]
WORDS += ["--hidden", "12", "12", "--batch-size", "16", "--warmup", "100", "--replay-size", "300"]
WORDS += ["--eval-every", "100", "--eval-episodes", "1", "--checkpoint-every", "0.05s"]
WORDS += ["--keep", "3", "--runs"]
PAGE = 4096
ROOM = 64 * 2**20  # bytes, more than a run needs


class Mounted:
    """A file system in memory of a size that can grow."""

    def __init__(self, folder: Path, size: int) -> None:
        self.folder = folder
        folder.mkdir()
        _mount("-t", "tmpfs", "-o", f"size={size}", "tmpfs", folder)

    def grow(self) -> None:
        """Make room."""
        _mount("-o", f"remount,size={ROOM}", self.folder)

    def close(self) -> None:
        """Let go of it, also where a map of a file lives on."""
        subprocess.run(["umount", "--lazy", self.folder], check=True)


class Limited:
    """A folder in which no file may grow beyond a size."""

    def __init__(self, folder: Path, size: int) -> None:
        self.folder = folder
        folder.mkdir()
        self.before = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, self.before[1]))

    def grow(self) -> None:
        """Make room."""
        resource.setrlimit(resource.RLIMIT_FSIZE, self.before)

    close = grow


def _mount(*words: object) -> None:
    subprocess.run(["mount", *map(str, words)], check=True, capture_output=True)


def here(folder: Path) -> type[Mounted | Limited]:
    """What this user may make."""
    try:
        Mounted(folder / "probe", PAGE).close()
    except (OSError, subprocess.CalledProcessError):
        return Limited
    return Mounted


def run(
    folder: Path, count: int, seed: int = 0, make: type[Mounted | Limited] | None = None
) -> Tally:
    """So many runs on disks of different sizes, which grow when the run has stopped."""
    rng, tally = random.Random(seed), Tally()
    with ExitStack() as stack:
        for name, value in RING.items():
            stack.enter_context(patched(buffer, name, value))
        command(*WORDS, folder / "whole")()
        whole = only_run(folder / "whole")
        make = make or here(folder)
        sizes = [file.stat().st_size for file in whole.path.rglob("*")]
        most = max(sizes) if make is Limited else sum(sizes) + PAGE * len(sizes)
        for number in range(count):
            size = rng.randrange(PAGE, 3 * most // 2)
            disk = make(folder / str(number), size)
            try:
                fault = _fault(disk, whole, tally)
            except Exception as error:
                fault = f"{type(error).__name__}: {error!s:.300}"
            finally:
                disk.close()
            tally.made += 1
            if fault:
                tally.wrong.append(f"{size} bytes: {fault}")
    return tally


def _fault(disk: Mounted | Limited, whole: RunDirectory, tally: Tally) -> str:
    """What is wrong with a run on a disk, and with how it goes on once there is room."""
    words, made, save = [*WORDS, disk.folder / "runs"], list[int](), checkpoint.save

    def save_and_note(loop: Any, *rest: Any) -> None:
        save(loop, *rest)
        made.append(loop.progress.tick)

    with patched(checkpoint, "save", save_and_note):
        for _ in range(2):
            if not _is_done(words):
                tally.refused += 1
            if not made:
                left = [*disk.folder.rglob("*")]
                assert not left, f"a refused start leaves {left}"
                continue
            run = only_run(disk.folder)
            if _newest(run) < made[-1]:
                return f"lost: tick {made[-1]}, at {_newest(run)}"
            words = ["resume", str(run.path), "-q"]
    disk.grow()
    command(*words)()
    run = only_run(disk.folder)
    assert_same(whole, run)
    return f"litter: {litter(run)}" if litter(run) else ""


def _is_done(words: list[Any]) -> bool:
    """Whether a command does what it should; else it must say so in a line."""
    try:
        command(*words)()
    except UsageError as error:
        if "space" not in str(error) and "too large" not in str(error):
            raise
        return False
    return True


def _newest(run: RunDirectory) -> int:
    """The tick of the newest whole checkpoint."""
    for file in (run.state_file, run.previous_file):
        try:
            return storage.read(file, "checkpoint").table["progress"]["tick"]
        except UsageError:
            continue
    return -1
