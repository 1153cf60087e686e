"""Runs by the names that people type."""

import os
import re
from collections.abc import Callable, Iterator
from glob import glob
from pathlib import Path, PurePath

from pacesetter.errors import UsageError
from pacesetter.files import present
from pacesetter.policy import file_of
from pacesetter.runs.directory import CONFIG, RunDirectory

SHOWN = 4  # runs that a refusal names
VERSION = re.compile(r"-v\d+$")  # of a Gymnasium id


def find_all(runs: str | Path = "runs") -> Iterator[RunDirectory]:
    """All runs below a folder, in order; folders that are links are entered too."""
    for path in sorted(_folders(Path(runs))):
        yield RunDirectory(path)


def _folders(runs: Path) -> Iterator[Path]:
    """Folders with a config, each once, so that a link in a circle ends."""
    seen: set[tuple[int, int]] = set()
    for folder, inner, files in os.walk(runs, followlinks=True):
        try:
            found = os.stat(folder)
        except OSError:  # it was there a moment ago
            continue
        if (found.st_dev, found.st_ino) in seen:
            inner.clear()
            continue
        seen.add((found.st_dev, found.st_ino))
        if CONFIG in files or CONFIG in inner:
            yield Path(folder)


def find(name: str, runs: str | Path = "runs") -> RunDirectory:
    """A run by its path, or by an end of its path or of its name that only one run has.

    The seed may be left out where there is only one, and the version of the task.
    """
    if present(Path(name) / CONFIG):
        return RunDirectory(Path(name))
    parts = _plain(name).parts
    ends = (0, 1) if parts else ()  # with the seed, or without
    for end in ends:
        here = slice(-len(parts) - end, -end or None)
        if found := _called(runs, lambda path, here=here: path.parts[here] == parts):
            break
    else:
        found = []
    if len(found) == 1:
        return found[0]
    if found:
        raise UsageError(
            f"run: '{name}' matches {_few(found)}; give more of its path, such as ENV/NAME/SEED"
        )
    if file_of(name):
        raise UsageError(f"run: {name} is a policy file; give a run, which has a log and states")
    known = list(find_all(runs))
    near = f"; there are {_few(known)}" if known else f"; no runs below {runs}, give --runs"
    raise UsageError(f"run: '{name}' not found{near}")


def find_group(name: str, runs: str | Path = "runs") -> list[RunDirectory]:
    """All seeds of what is called so, such as HalfCheetah-v5/td3 or multi-td3."""
    pattern = str(_plain(name))
    return _called(runs, lambda path: path.parent.match(pattern))


def find_matching(pattern: str, runs: str | Path = "runs") -> list[RunDirectory]:
    """All runs that a pattern fits, with the seed or without it."""
    pattern = str(_plain(pattern))
    return _called(runs, lambda path: path.match(pattern) or path.parent.match(pattern))


def find_each(word: str, runs: str | Path = "runs") -> list[RunDirectory]:
    """The runs that a word names: a run, a folder of runs, the tail of either, or a pattern.

    Raises UsageError if there is none.
    """
    if below := list(find_all(word) if Path(word).is_dir() else []):
        return below
    if not any(mark in word for mark in "*?["):
        return find_group(word, runs) or [find(word, runs)]
    below = [run for path in sorted(glob(word)) for run in find_all(path)]
    if below := below + find_matching(word, runs):
        return below
    raise UsageError(f"run: '{word}' matches no run here or below {runs}")


def _called(runs: str | Path, fits: Callable[[PurePath], bool]) -> list[RunDirectory]:
    """Runs whose folder fits, or else those of which another spelling does."""
    every = list(find_all(runs))
    own = [run for run in every if fits(run.path)]
    return own or [run for run in every if any(map(fits, _spellings(run)))]


def _spellings(run: RunDirectory) -> Iterator[PurePath]:
    """The run's folder with its task as it was typed, and without its module or its version.

    The folder of `module:Id-v0` is module-Id-v0, and that of `group/Id-v0` group-Id-v0.
    """
    try:
        env = run.settings()["env"]
    except UsageError:  # damaged, which is for its own commands to say
        return
    *above, _, name, seed = ("", "", *run.path.parts)
    for typed in (str(_plain(env)), env.split(":")[-1], PurePath(env).name):
        yield PurePath(*above, typed, name, seed)
        yield PurePath(*above, VERSION.sub("", typed), name, seed)


def _plain(name: str) -> PurePath:
    """As folders are named, which hold no colon."""
    if not name.strip():
        raise UsageError("run: its name is empty; `pacesetter list runs` shows them all")
    return PurePath(name.replace(":", "-"))


def _few(runs: list[RunDirectory]) -> str:
    return ", ".join(str(run.path) for run in runs[:SHOWN])
