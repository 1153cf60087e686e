"""Kinds of values that settings have: counts, lengths of time, and the ranges that `tune` takes."""

import re
from typing import Annotated, Any, NamedTuple

from pydantic import AfterValidator, BeforeValidator, Field

from pacesetter.errors import UsageError

_MULTIPLES = {"": 1, "k": 1_000, "m": 1_000_000}
_SECONDS = {"": 1, "s": 1, "m": 60, "h": 3600, "d": 86400}


def _count(value: object) -> object:
    found = re.fullmatch(r"(\d+(?:\.\d+)?(?:e\d+)?)([km]?)", str(value).strip().lower())
    if found is None:
        raise ValueError("is not a count; write 5000, 300k, 1M or 1e6")
    number = float(found[1]) * _MULTIPLES[found[2]]
    if number > 1e15:
        raise ValueError("is too large")
    if number != int(number):
        raise ValueError("is not a whole number")
    return int(number)


def _duration(value: object) -> object:
    found = re.fullmatch(r"(\d+(?:\.\d+)?)([smhd]?)", str(value).strip().lower())
    if value is not None and found is None:
        raise ValueError("is not a length of time; write 90s, 5m or 2h")
    return value if found is None else float(found[1]) * _SECONDS[found[2]]


def _numbers(words: str) -> str:
    number = r"-?[0-9]{1,9}"
    each = f"({number}|({number})?:({number})?)"
    if not re.fullmatch(f"{each}(,{each})*", words):
        raise ValueError("is no list of numbers and ranges; write 0:17, :-4 or 0:8,12")
    return words


def chosen(name: str, words: str, size: int) -> list[bool]:
    """Which of so many numbers the words of a setting choose; ranges are as in Python.

    Raises UsageError for a number that there is not, and for a range without any.
    """
    every = [False] * size
    for word in words.split(","):
        first, *last = (int(end) if end else None for end in word.split(":"))
        found = range(size)[first : last[0] if last else (first or 0) + 1 or None]
        if not found or any(abs(end or 0) > size for end in (first, *last)):
            raise UsageError(f"{name}: {word} is not among the {size} numbers 0:{size}")
        for number in found:
            every[number] = True
    return every


def values_by_name(value: Any) -> Any:
    """Words such as gamma=0.98,0.99 as a table; a table from a file as it is."""
    if isinstance(value, dict):
        return {str(name).replace("-", "_"): each for name, each in value.items()}
    if not isinstance(value, (list, tuple)):
        raise ValueError("must be NAME=VALUE,VALUE or a table of lists")
    found: dict[str, list[str]] = {}
    for word in map(str, value):
        name, sign, values = word.partition("=")
        name = name.replace("-", "_")
        if not (name and sign and values):
            raise ValueError("must be NAME=VALUE,VALUE, such as gamma=0.98,0.99")
        if name in found:
            raise ValueError(f"has {name} twice; give all its values at once")
        found[name] = values.split(",")
    return found


class Tune(NamedTuple):
    """The range in which `tune` searches a setting: two numbers, or False and True."""

    low: float
    high: float
    log: bool = False

    def has(self, value: Any) -> bool:
        """Whether a value is in the range."""
        return self.low <= value <= self.high


Width = Annotated[int, Field(ge=1, le=16_384)]
SmallCount = Annotated[int, Field(ge=1, le=1_000_000)]
SmallCountOr0 = Annotated[int, Field(ge=0, le=1_000_000)]
LARGEST_COUNTED = 2**31 - 1  # what a learner's program compares with one of its counters
Count = Annotated[int, BeforeValidator(_count)]
Indices = Annotated[str, AfterValidator(_numbers)]
Duration = Annotated[float, BeforeValidator(_duration)]
LearningRate = Annotated[float, Tune(1e-4, 3e-3, log=True)]
Tau = Annotated[float, Tune(1e-3, 0.02, log=True)]
Warmup = Annotated[Count, Tune(1_000, 25_000, log=True)]
Switch = Annotated[bool, Tune(False, True)]
