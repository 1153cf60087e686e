"""Which way of drawing rows the settings ask for."""

from typing import Any

from pacesetter.replay.by_return import ByReturn
from pacesetter.replay.prioritized import MEASURES, ByError
from pacesetter.replay.sampler import Drawing, Uniform


def choose(hyper: Any, size: int) -> Drawing:
    """The drawing that settings ask for, of a replay with at most `size` rows."""
    exponent, importance = hyper.exponents
    if hyper.replay == "uniform":
        return Uniform()
    if hyper.replay == "return":
        return ByReturn(size, exponent, importance, hyper.replay_to_go)
    return ByError(size, exponent, importance, MEASURES[hyper.replay])
