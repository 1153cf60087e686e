"""How learning rates change over a run: pure functions of the updates that were made."""

from dataclasses import fields
from typing import Any


def learning_rates(hyper: Any) -> list[str]:
    """The names of an algorithm's learning rates."""
    return [field.name for field in fields(hyper) if field.name.endswith("learning_rate")]


def linear(updates: int, horizon: float, end: float) -> float:
    """The factor of a rate after so many updates: from 1 to `end` over the horizon, then `end`."""
    return 1.0 + min(updates / horizon, 1.0) * (end - 1.0)


def factors(hyper: Any, scales: dict[str, float], updates: int, horizon: float) -> dict[str, float]:
    """Factors of a member's settings; those of learning rates times that of `--lr-end`."""
    if hyper.lr_end == 1:
        return scales
    factor = linear(updates, horizon, hyper.lr_end)
    return scales | {name: factor * scales.get(name, 1.0) for name in learning_rates(hyper)}
