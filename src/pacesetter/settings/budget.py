"""What a run may spend, read off its flat settings: env steps, time, and a return to stop at."""

from pacesetter.settings import Settings


def steps_per_count(settings: Settings) -> int:
    """Env steps of all members for each one that `--steps` and the intervals count."""
    return settings["members"] if settings["count"] == "member" else 1


def budget(settings: Settings) -> int:
    """Env steps that all members make together, until a run is over."""
    return settings["steps"] * steps_per_count(settings)


def out_of_time(settings: Settings, wall_seconds: float) -> bool:
    """Whether a run has a limit of time and has reached it."""
    limit = settings.get("time")
    return limit is not None and wall_seconds >= limit


def is_reached(settings: Settings, best: float | None) -> bool:
    """Whether a run has a return to reach and an evaluation's mean has reached it."""
    goal = settings.get("stop_at")
    return goal is not None and best is not None and best >= goal


def is_spent(settings: Settings, step: float, wall_seconds: float, best: float | None) -> bool:
    """Whether a run has made all its env steps, is out of time, or has reached its return.

    `best` is the highest mean return of its evaluations.
    """
    over = step >= budget(settings) or out_of_time(settings, wall_seconds)
    return over or is_reached(settings, best)
