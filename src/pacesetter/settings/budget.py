"""What a run may spend, read off its flat settings: env steps, and time if it is limited."""

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


def is_spent(settings: Settings, step: float, wall_seconds: float) -> bool:
    """Whether a run has made all its env steps or is out of time."""
    return step >= budget(settings) or out_of_time(settings, wall_seconds)
