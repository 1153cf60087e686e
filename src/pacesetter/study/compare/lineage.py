"""Selections of a run: how certain each was, and which member descends from which."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pacesetter.study.compare.stats import Array

Places = NDArray[np.int64]


@dataclass(frozen=True)
class Selections:
    """S selections among K members: steps, gaps, errors, champions (S,) and parents (S, K)."""

    steps: Array
    gaps: Array
    errors: Array
    parents: Places
    champions: Places

    @classmethod
    def of(cls, rows: list[Any]) -> "Selections":
        """From the rows [step, gap, standard error, parents, champion] of a run's results."""
        steps, gaps, errors, parents, champions = zip(*rows, strict=True)
        return cls(
            np.array(steps, dtype=float),
            np.array(gaps, dtype=float),
            np.array(errors, dtype=float),
            np.array(parents),
            np.array(champions),
        )

    @property
    def ratios(self) -> Array:
        """Gap over its standard error (S,); 0 where both are 0."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.nan_to_num(self.gaps / self.errors, nan=0.0, posinf=np.inf)

    @property
    def flips(self) -> NDArray[np.bool_]:
        """Which selections (S,) were closer than one standard error: little but chance."""
        return self.ratios < 1

    @cached_property
    def ancestors(self) -> Places:
        """The founder that each place descends from after each selection: (S, K)."""
        places = np.arange(self.parents.shape[1])
        found: list[Places] = []
        for parents in self.parents:
            places = places[parents]
            found.append(places)
        return np.array(found)

    @property
    def founding(self) -> str:
        """The one founder of all members, and the number of the selection since when."""
        alone = np.flatnonzero((self.ancestors == self.ancestors[:, :1]).all(axis=1))
        if not alone.size:
            left = len(np.unique(self.ancestors[-1]))
            return f"{left} of {self.parents.shape[1]} founders left"
        return f"{self.ancestors[-1, 0]}, since selection {alone[0] + 1}"

    @property
    def line(self) -> list[int]:
        """Places through which the last champion descends: before each selection (S,)."""
        place, found = int(self.champions[-1]), list[int]()
        for parents in self.parents[::-1]:
            place = int(parents[place])
            found.append(place)
        return found[::-1]


def settings_along(found: Selections, varied: list[Any], name: str) -> list[float]:
    """A setting's values along the line of the last champion (S + 1,).

    `varied` has the values of all members by name, at the start and after each selection.
    """
    places = [*found.line, int(found.champions[-1])]
    return [values[name][place] for values, place in zip(varied, places, strict=True)]


def shorten(line: Sequence[float], most: int = 12) -> str:
    """A line with repeats counted, such as 0 1x3 0x2; its end, if it is long."""
    words = [
        f"{place}x{count}" if count > 1 else str(place)
        for place, count in ((place, len(list(same))) for place, same in groupby(line))
    ]
    return " ".join(words if len(words) <= most else ["...", *words[-most:]])


def diagram(found: Selections, width: int = 3, height: int = 22) -> tuple[str, str, int, int]:
    """SVG paths of all copies and of the champion's line, and the size they need.

    Time goes right, one selection after another; each member has its own height.
    """
    count, members = found.parents.shape
    every = [
        _stroke(time, int(parent), place, width, height)
        for time, parents in enumerate(found.parents)
        for place, parent in enumerate(parents)
    ]
    line = [*found.line, int(found.champions[-1])]
    own = [_stroke(time, line[time], line[time + 1], width, height) for time in range(count)]
    return "".join(every), "".join(own), count * width, members * height


def _stroke(time: int, start: int, end: int, width: int, height: int) -> str:
    top = height // 2
    return f"M{time * width} {top + start * height}L{(time + 1) * width} {top + end * height}"
