"""Errors for people, in one line: the field, what is wrong, what is allowed."""

from collections.abc import Iterable
from difflib import get_close_matches
from typing import Any

MAX_LENGTH = 500  # characters


class _OneLine(Exception):  # noqa: N818
    code = 1  # with which the command ends

    def __init__(self, message: str) -> None:
        text = " ".join(message.split())
        super().__init__(text if len(text) <= MAX_LENGTH else f"{text[:MAX_LENGTH]}...")


class UsageError(_OneLine):
    """Bad input: an unknown name, a value out of range, a damaged file."""

    code = 2


class InUseError(UsageError):
    """A run, or another file, that another process holds: to be tried again later."""

    code = 75  # EX_TEMPFAIL of sysexits.h


class TrainingError(_OneLine):
    """A run that cannot continue, such as one with a NaN; its last good checkpoint is kept."""


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
            raise TrainingError(f"{self.where}: {error}") from error
