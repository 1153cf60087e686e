"""Experiment: the power fails, and what was not synced is forgotten: data, names and folders."""

import errno
import mmap
import os
import random
import stat
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from attempts import Tally, patched
from short_runs import TINY, assert_same, run_to_end, run_to_step
from stopping import RING, litter, only_run

from pacesetter import policy
from pacesetter.errors import UsageError
from pacesetter.replay import buffer
from pacesetter.runs import RunDirectory
from pacesetter.training.trainer import Trainer

OPERATIONS = ("open", "fsync", "replace", "rename", "link", "unlink", "mkdir", "rmdir")
PAGE = mmap.PAGESIZE
SETTINGS: dict[str, Any] = TINY | {"hidden": (4,), "steps": 500, "replay_size": 150}
SETTINGS |= {"members": 2, "eval_every": 100, "keep": 2}
SAVE_EVERY = 20  # steps
EXPECTED = 1_200  # operations on files in one session


class Disk:
    """A folder, and what of it a power cut would leave."""

    def __init__(self, root: Path, rng: random.Random) -> None:
        self.root, self.rng = root, rng
        self._data: dict[int, bytes] = {}  # of synced files, by their inode
        self._names: dict[int, dict[str, int]] = {}  # of synced folders
        self._folders: set[int] = set()
        self._held: list[int] = []  # no number of an inode is used twice while it is open

    def sync(self, file: int) -> None:
        """Note what is safe from now on."""
        self._held.append(os.dup(file))
        about = os.fstat(file)
        if stat.S_ISDIR(about.st_mode):
            self._names[about.st_ino] = self._now(Path(f"/proc/self/fd/{file}"))
        else:
            self._data[about.st_ino] = Path(f"/proc/self/fd/{file}").read_bytes()

    def flush(self, inode: int, start: int, data: bytes, size: int) -> None:
        """Note that some bytes of a file are safe from now on."""
        old = self._data.get(inode, b"").ljust(size, b"\0")
        self._data[inode] = old[:start] + data + old[start + len(data) :]

    def hold(self, file: int) -> int:
        """Keep a file's inode, and return it."""
        self._held.append(os.dup(file))
        return os.fstat(file).st_ino

    def leave(self, to: Path, kept: float) -> None:
        """Write what a power cut would leave now, where a share of the rest was written too."""
        paths = {each.lstat().st_ino: each for each in (self.root, *self.root.rglob("*"))}

        def folder(inode: int, to: Path) -> None:
            to.mkdir()
            now = self._now(paths[inode]) if inode in paths else {}
            before = self._names.get(inode, {})
            for name in sorted({*before, *now}):
                chosen = (now if self.rng.random() < kept else before).get(name)
                if chosen in self._folders:
                    folder(chosen, to / name)
                elif chosen is not None:
                    (to / name).write_bytes(self._content(chosen, paths.get(chosen), kept))

        folder(self.root.stat().st_ino, to)

    def close(self) -> None:
        """Let go of what was held."""
        for file in self._held:
            os.close(file)

    def _now(self, path: Path) -> dict[str, int]:
        found = [*os.scandir(path)]
        self._folders |= {each.inode() for each in found if each.is_dir()}
        return {each.name: each.inode() for each in found}

    def _content(self, inode: int, path: Path | None, kept: float) -> bytes:
        """Each page of a file as it was synced or, by chance, as it is now."""
        old = self._data.get(inode, b"")
        new = old if path is None else path.read_bytes()
        size = len(new if self.rng.random() < kept else old)
        old, new = (each[:size].ljust(size, b"\0") for each in (old, new))
        starts = range(0, size, PAGE)
        return b"".join(
            (new if self.rng.random() < kept else old)[start : start + PAGE] for start in starts
        )


@contextmanager
def recorded(disk: Disk, before_each: Callable[[], None]) -> Iterator[None]:
    """Tell the disk what is synced, and call something before each operation on files."""

    def recording(operation: Callable[..., Any], syncs: bool) -> Callable[..., Any]:
        def act(*words: Any, **named: Any) -> Any:
            before_each()
            result = operation(*words, **named)
            if syncs:
                disk.sync(words[0])
            return result

        return act

    class Map(mmap.mmap):
        def __init__(self, file: int, size: int) -> None:
            self.inode = disk.hold(file)

        def flush(self, start: int = 0, size: int | None = None) -> None:
            before_each()
            super().flush(start, len(self) - start if size is None else size)
            end = len(self) if size is None else start + size
            disk.flush(self.inode, start, self[start:end], len(self))

    with ExitStack() as stack:
        for name in OPERATIONS:
            action = recording(getattr(os, name), name == "fsync")
            stack.enter_context(patched(os, name, action))
        stack.enter_context(patched(buffer.mmap, "mmap", Map))
        yield


class Cut:
    """What one power cut left, and the tick of the checkpoint that had been made before it."""

    def __init__(self, folder: Path, made: int | None) -> None:
        self.folder, self.made = folder, made

    def fault(self, whole: RunDirectory, to_end: bool) -> str:
        """What is wrong with what is left."""
        try:
            return self._fault(whole, to_end)
        except UsageError as error:
            return "" if self.made is None else f"lost: {error}"
        except Exception as error:
            return f"{type(error).__name__}: {error!s:.200}"

    def _fault(self, whole: RunDirectory, to_end: bool) -> str:
        if self.made is None and not [*self.folder.rglob("config.json")]:
            return ""
        run = only_run(self.folder)
        for file in run.path.rglob("*.safetensors"):
            if file.parent != run.state_file.parent:
                policy.load(file)
        trainer = Trainer.resume(run.path)
        try:
            if self.made is None:
                return ""
            if trainer.notes:
                return f"{trainer.notes}"
            if trainer.progress.tick < self.made:
                return f"lost: tick {self.made}, at {trainer.progress.tick}"
            if litter(run):
                return "litter"
            if to_end:
                run_to_end(trainer)
                assert_same(whole, run)
        finally:
            trainer.close()
        return ""


def run(folder: Path, count: int, seed: int = 0) -> Tally:
    """So many cuts of runs that are made, stopped, resumed and ended, saving all the while."""
    rng, tally = random.Random(seed), Tally()
    with ExitStack() as stack:
        for name, value in RING.items():
            stack.enter_context(patched(buffer, name, value))
        whole = run_to_end(_new(folder / "whole"))
        for session in range(count):
            cuts = _session(folder / str(session), count - tally.made, rng, session % 2 == 0)
            for cut in cuts:
                fault = cut.fault(whole, to_end=tally.made % 5 == 0)
                tally.made += 1
                if fault:
                    tally.wrong.append(f"cut {cut.folder.name} of session {session}: {fault}")
            if tally.made == count:
                break
    return tally


def _session(folder: Path, most: int, rng: random.Random, links: bool) -> list[Cut]:
    """One run from its start to its end, and at most so many cuts of it.

    Without second names of files, a checkpoint is renamed, which a file system does as a whole.
    """
    shares = (0, 0, 0.5, 1) if links else (0, 1)
    root = folder / "disk"
    root.mkdir(parents=True)
    disk, cuts, made, busy = Disk(root, rng), list[Cut](), list[int](), list[bool]()

    def maybe_cut() -> None:
        if busy or len(cuts) == most or rng.random() > most / EXPECTED:
            return
        busy.append(True)
        cuts.append(Cut(folder / str(len(cuts)), made[-1] if made else None))
        disk.leave(cuts[-1].folder, rng.choice(shares))
        busy.clear()

    with ExitStack() as stack:
        if not links:
            stack.enter_context(patched(os, "link", _no_link))
        stack.enter_context(recorded(disk, maybe_cut))
        trainer = _new(root / "runs")
        made.append(0)
        run_to_step(_saving(trainer, made), SETTINGS["steps"] // 2)
        run_to_end(_saving(Trainer.resume(trainer.directory.path), made))
    disk.close()
    return cuts


def _no_link(*names: object) -> None:
    raise OSError(errno.EPERM, os.strerror(errno.EPERM))


def _new(runs: Path) -> Trainer:
    return Trainer("td3", "Pendulum-v1", runs=runs, **SETTINGS)


def _saving(trainer: Trainer, made: list[int]) -> Trainer:
    """The trainer, which saves often and notes the tick of each checkpoint that it made."""
    tick, save = trainer.loop.tick, trainer.save

    def tick_and_save() -> Any:
        selection = tick()
        if trainer.progress.step % SAVE_EVERY == 0:
            trainer.save()
        return selection

    def save_and_note() -> None:
        save()
        made.append(trainer.progress.tick)

    vars(trainer)["save"] = save_and_note
    trainer.loop.tick = tick_and_save
    return trainer
