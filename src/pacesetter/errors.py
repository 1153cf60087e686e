"""Errors for people, in one line: the field, what is wrong, what is allowed."""

import sys
from collections.abc import Generator, Iterable
from contextlib import contextmanager
from difflib import get_close_matches
from pathlib import Path
from traceback import extract_tb
from typing import Any

from pacesetter.text import printable

MAX_LENGTH = 500  # characters
SHOWN = 80  # characters of a value that is not what it should be


class _OneLine(Exception):  # noqa: N818
    code = 1  # with which the command ends

    def __init__(self, message: str) -> None:
        text = printable(" ".join(message.split()))
        super().__init__(text if len(text) <= MAX_LENGTH else f"{text[:MAX_LENGTH]}...")


class UsageError(_OneLine):
    """Bad input: an unknown name, a value out of range, a damaged file."""

    code = 2


class InUseError(UsageError):
    """A run, or another file, that another process holds: to be tried again later."""

    code = 75  # EX_TEMPFAIL of sysexits.h


class TrainingError(_OneLine):
    """A run that cannot continue, such as one with a NaN; its last good checkpoint is kept."""


class TaskError(TrainingError):
    """A fault of the task: it raised, exited, or gave what it must not."""


def tell(line: str) -> None:
    """A line for people, on stderr."""
    print(f"pacesetter: {line}", file=sys.stderr, flush=True)


@contextmanager
def told(what: str, *kinds: type[Exception]) -> Generator[None]:
    """Tell errors of these kinds in a line on stderr instead of raising them."""
    try:
        yield
    except kinds as error:
        tell(f"{what}: {reason(error)}")


@contextmanager
def writing(what: str, path: object) -> Generator[None]:
    """Refuse in one line what cannot be written."""
    try:
        yield
    except OSError as error:
        raise UsageError(f"{what}: cannot write {path}: {error.strerror or error}") from None


def reason(error: BaseException) -> str:
    """Why something failed, by the exception of code that is not ours: its kind and whole text.

    One without a text, such as a bare assert, is told by its place. Some cannot even make theirs.
    """
    kind = type(error).__name__
    try:
        text = str(error).strip()
    except Exception:
        text = ""
    frames = extract_tb(error.__traceback__)
    if text or not frames:
        return f"{kind}: {text}" if text else kind
    last = frames[-1]
    return f"{kind} in {Path(last.filename).name}, line {last.lineno}: {last.line}"


def show(value: object) -> str:
    """A value of code that is not ours, short and in one line, even if it cannot be printed."""
    try:
        text = " ".join(repr(value).split())
    except Exception:
        return f"a {type(value).__name__} that cannot be printed"
    return text if len(text) <= SHOWN else f"{text[:SHOWN]}..."


def unknown(
    kind: str, word: str, options: Iterable[str], see: str = "pacesetter list"
) -> UsageError:
    """Refuse an unknown name and offer the nearest ones that exist."""
    options = sorted(options)
    near = get_close_matches(word, options, n=3, cutoff=0.6)
    if near:
        hint = f"did you mean {' or '.join(near)}?"
    elif len(options) <= 16:
        hint = f"allowed: {', '.join(options)}"
    else:
        hint = f"{len(options)} are known; see `{see}`"
    return UsageError(f"{kind}: unknown '{word}'; {hint}")


class blame:  # noqa: N801 (a context manager reads as a verb)
    """Add the member (or env) and the step to a TrainingError."""

    def __init__(self, number: int, step: int, who: str = "member") -> None:
        self.where = f"{who} {number}, step {step}"

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: Any, error: BaseException | None, trace: Any) -> None:
        if isinstance(error, TrainingError):
            raise type(error)(f"{self.where}: {error}") from error
