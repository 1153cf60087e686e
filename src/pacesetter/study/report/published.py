"""Returns that other people published: the data of published.toml."""

import tomllib
from functools import cache
from pathlib import Path
from typing import Any

Source = dict[str, Any]


@cache
def _file() -> dict[str, Any]:
    return tomllib.loads(Path(__file__).with_name("published.toml").read_text("utf-8"))


def sources() -> list[Source]:
    """All sources, with their returns as {task: [mean, standard deviation]} or [mean] alone."""
    return _file()["source"]


def scale(task: str) -> float | None:
    """Published return that is a score of one on a task."""
    return _file()["scale"].get(task)
