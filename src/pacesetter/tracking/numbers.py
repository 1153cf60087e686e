"""A row of the log as named numbers, which is all that a tracker can plot."""

from collections.abc import Iterator
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
            yield f"{name}/{column}", _mean(entries)
    elif isinstance(value, dict):
        for key, each in value.items():
            yield from _named(f"{name}/{key}", each, ())
    elif isinstance(value, list):
        for index, each in enumerate(value):
            yield f"{name}/{index}", _mean(each) if isinstance(each, list) else float(each)
    elif isinstance(value, (int, float)):
        yield name, float(value)


def _mean(values: Any) -> float:
    return float(sum(values) / len(values))
