"""What a run may spend, read off its flat settings: env steps, time, and when to stop early."""

from collections.abc import Iterable
from typing import NamedTuple

from pacesetter.settings import Settings


def steps_per_count(settings: Settings) -> int:
    """Env steps of all members for each one that `--steps` and the intervals count."""
    return settings.get("members", 1) if settings.get("count") == "member" else 1


def budget(settings: Settings) -> int:
    """Env steps that all members make together, until a run is over."""
    return settings["steps"] * steps_per_count(settings)


def out_of_time(settings: Settings, wall_seconds: float) -> bool:
    """Whether a run has a limit of time and has reached it."""
    limit = settings.get("time")
    return limit is not None and wall_seconds >= limit


class Standing(NamedTuple):
    """How a run's evaluations stand: the highest mean return, and how many came since."""

    best: float | None = None
    since: int = 0

    def after(self, mean: float, updates: float) -> "Standing":
        """With one evaluation more. One before the first update cannot have made progress."""
        if self.best is None or mean > self.best:
            return Standing(mean)
        return Standing(self.best, self.since + (updates > 0))


def standing(evaluations: Iterable[tuple[float, float, float]]) -> Standing:
    """How evaluations stand, given as (step, mean return, updates); that of step 0 is not asked."""
    found = Standing()
    for step, mean, updates in evaluations:
        found = found.after(mean, updates) if step > 0 else found
    return found


def is_settled(settings: Settings, standing: Standing) -> bool:
    """Whether the evaluations end a run: its return is reached, or it makes no progress."""
    goal, patience = settings.get("stop_at"), settings.get("stop_patience")
    reached = goal is not None and standing.best is not None and standing.best >= goal
    return reached or (patience is not None and standing.since >= patience)


def is_spent(settings: Settings, step: float, wall_seconds: float, standing: Standing) -> bool:
    """Whether a run has made all its env steps, is out of time, or is settled."""
    over = step >= budget(settings) or out_of_time(settings, wall_seconds)
    return over or is_settled(settings, standing)
