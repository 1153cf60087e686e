"""The runs that words of the command line name: folders, patterns, and files of results."""

import json
from collections.abc import Iterable, Iterator
from glob import glob
from pathlib import Path
from typing import Any

from pacesetter.errors import UsageError
from pacesetter.runs import RunDirectory, find, find_all, find_group, find_matching
from pacesetter.study.compare.results import Run, compact, read


def gather(words: Iterable[str | Path], runs: str | Path = "runs") -> tuple[list[Run], list[str]]:
    """All runs that the words name, each once, and those that have no evaluation yet.

    A word is a file of results, a run, a folder of runs, the tail of either, or a pattern.
    """
    found: dict[str, Run] = {}
    empty: list[str] = []
    for word in words:
        for source, table, folder in _sources(str(word), Path(runs)):
            key = str(Path(source).resolve())
            if key in found:
                continue
            run = read(source, compact(RunDirectory(folder)) if folder else table, folder)
            if run is None:
                empty.append(source)
            else:
                found[key] = run
    return list(found.values()), empty


def _sources(word: str, runs: Path) -> Iterator[tuple[str, Any, Path | None]]:
    if Path(word).is_file():
        yield from _lines(Path(word))
        return
    for run in _directories(word, runs):
        yield str(run.path), None, run.path


def _directories(word: str, runs: Path) -> list[RunDirectory]:
    if below := list(find_all(word) if Path(word).is_dir() else []):
        return below
    if not any(mark in word for mark in "*?["):
        return find_group(word, runs) or [find(word, runs)]
    below = [run for path in sorted(glob(word)) for run in find_all(path)]
    if below := below + find_matching(word, runs):
        return below
    raise UsageError(f"run: '{word}' matches no run here or below {runs}")


def _lines(path: Path) -> Iterator[tuple[str, Any, Path | None]]:
    if path.suffix != ".jsonl":
        raise UsageError(f"run: {path} is neither a run's folder nor a .jsonl file of results")
    try:
        for number, line in enumerate(path.read_text("utf-8").splitlines(), 1):
            yield f"{path}:{number}", json.loads(line), None
    except (OSError, ValueError, RecursionError) as error:
        raise UsageError(f"{path}: damaged: {error}") from None
