"""A row of the log as named numbers, which is all that a tracker can plot."""

from collections.abc import Iterable, Iterator
from math import isfinite
from typing import Any

from pacesetter.runs import Row

# Fields that list events, each with its member first: a tracker gets the mean of each column.
EVENTS = {"episodes_ended": ("return", "length"), "assessed": ("kept",)}


def numbers(row: Row) -> dict[str, float]:
    """The numbers of a row by name: KIND/FIELD, as in docs/log-fields.md.

    A list has a name per entry, KIND/FIELD/0 and so on; a table has one per key.
    """
    found: dict[str, float] = {}
    for field, value in row.items():
        if field not in ("kind", "step"):
            found |= _named(f"{row['kind']}/{field}", value, EVENTS.get(field, ()))
    return found


def _named(name: str, value: Any, columns: tuple[str, ...]) -> Iterator[tuple[str, float]]:
    if columns:
        for column, entries in zip(columns, list(zip(*value, strict=True))[1:], strict=False):
            yield from _mean(f"{name}/{column}", entries)
    elif isinstance(value, dict):
        for key, each in value.items():
            yield from _named(f"{name}/{key}", each, ())
    elif isinstance(value, list):
        for index, each in enumerate(value):
            yield from _mean(f"{name}/{index}", each if isinstance(each, list) else [each])
    else:
        yield from _mean(name, [value])


def _mean(name: str, values: Iterable[Any]) -> Iterator[tuple[str, float]]:
    """The mean of what is a number; NaN and infinity are null in the log, and no tracker gets a
    point of them.
    """
    found = [float(value) for value in values if isinstance(value, (int, float))]
    found = [value for value in found if isfinite(value)]
    if found:
        yield name, sum(found) / len(found)
