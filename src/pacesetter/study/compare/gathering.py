"""The runs that words of the command line name: folders, patterns, and files of results."""

import json
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import NamedTuple

from pacesetter.errors import UsageError
from pacesetter.runs import RunDirectory, find_each
from pacesetter.storage import FAULTS
from pacesetter.study.compare.results import Run, compact, read


class Gathered(NamedTuple):
    """What was found: runs, those without an evaluation yet, and why each damaged one is none."""

    runs: list[Run]
    empty: list[str]
    damaged: list[str]


def gather(words: Iterable[str | Path], runs: str | Path = "runs") -> Gathered:
    """All runs that the words name, each once.

    A word is a file of results, a run, a folder of runs, the tail of either, or a pattern. One that
    names nothing is refused; a run that cannot be read is left out.
    """
    found: dict[str, Run] = {}
    empty: list[str] = []
    damaged: dict[str, str] = {}
    for word in words:
        for source, load in _sources(str(word), Path(runs)):
            key = str(Path(source).resolve())
            if key in found or key in damaged:
                continue
            try:
                run = load(source)
            except UsageError as error:
                damaged[key] = str(error)
            except FAULTS as error:
                damaged[key] = str(UsageError(f"{source}: damaged: {error}"))
            else:
                if run is None:
                    empty.append(source)
                else:
                    found[key] = run
    return Gathered([*found.values()], empty, [*damaged.values()])


def _sources(word: str, runs: Path) -> Iterator[tuple[str, Callable[[str], Run | None]]]:
    """Each run by its place, and what reads it from there."""
    if Path(word).is_file():
        for number, line in enumerate(_lines(Path(word)), 1):
            yield f"{word}:{number}", partial(_of_line, line)
        return
    for run in find_each(word, runs):
        yield str(run.path), partial(_of_folder, run)


def _of_line(line: bytes, source: str) -> Run | None:
    return read(source, json.loads(line))


def _of_folder(run: RunDirectory, source: str) -> Run | None:
    return read(source, compact(run), run.path)


def _lines(path: Path) -> list[bytes]:
    if path.suffix != ".jsonl":
        raise UsageError(f"run: {path} is neither a run's folder nor a .jsonl file of results")
    try:
        return path.read_bytes().splitlines()
    except OSError as error:
        raise UsageError(f"{path}: cannot be read: {error.strerror}") from None
