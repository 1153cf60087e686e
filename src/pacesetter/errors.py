"""What can go wrong, said to people in one line: the field, the fault, what is allowed."""

from collections.abc import Iterable
from difflib import get_close_matches
from typing import Any

LONGEST = 500


class _OneLine(Exception):  # noqa: N818
    def __init__(self, message: str) -> None:
        text = " ".join(message.split())
        super().__init__(text if len(text) <= LONGEST else f"{text[:LONGEST]}...")


class UsageError(_OneLine):
    """Bad input: an unknown name, a value out of range, a damaged file. Exit code 2."""


class TrainingError(_OneLine):
    """A run that cannot go on, such as one with a NaN; its last good checkpoint is kept."""


def unknown(
    kind: str, word: str, options: Iterable[str], see: str = "pacesetter list"
) -> UsageError:
    """Refuse an unknown name, with the nearest ones that exist."""
    options = sorted(options)
    near = get_close_matches(word, options, n=3, cutoff=0.6)
    if near:
        hint = f"did you mean {' or '.join(near)}?"
    elif len(options) <= 12:
        hint = f"allowed: {', '.join(options)}"
    else:
        hint = f"{len(options)} are known; see `{see}`"
    return UsageError(f"{kind}: unknown '{word}'; {hint}")


class blame:  # noqa: N801 (a context manager reads as a verb)
    """Name member (or env) and step in whatever an env does wrong."""

    def __init__(self, number: int, step: int, who: str = "member") -> None:
        self.where = f"{who} {number}, step {step}"

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: Any, error: BaseException | None, trace: Any) -> None:
        if isinstance(error, TrainingError):
            raise TrainingError(f"{self.where}: {error}") from error
