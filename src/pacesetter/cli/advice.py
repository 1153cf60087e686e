"""What a person should know of a run's settings before hours are spent on it."""

from math import inf
from typing import TYPE_CHECKING, Any

from pacesetter.settings.budget import budget

if TYPE_CHECKING:
    from pacesetter.config import Config
    from pacesetter.training.trainer import Trainer

SAMPLE = 20.0  # seconds of updates that an estimate rests on
LONG = 24 * 3600.0  # seconds from which a run's length is worth a line
SLOW = 5.0  # updates per second below which a run is worth a line before a day is
SOON = 10 * 60.0  # seconds that nobody minds, however slow the updates are
WIDE = 256  # units of a layer that a CPU updates quickly


def within_warmup(config: "Config") -> str | None:
    """One line on a run that would never learn, as its budget ends within the warm-up."""
    hyper: Any = config.hyper
    steps, warmup = budget(config.settings()), getattr(hyper, "warmup", 0)
    each = getattr(hyper, "block", 1)
    block = each * config.run.members if each > 1 else 1
    if steps // block * block > warmup or getattr(hyper, "warmup_updates", False):
        return None
    less = max(steps // 10, 1)
    blocks = f", and the rest is less than a block of {block:,}" if steps > warmup else ""
    return (
        f"warmup: the run has {steps:,} steps and acts at random for the first {warmup:,}{blocks}, "
        f"so nothing is learned; give more --steps, or a shorter warm-up such as --warmup {less}"
    )


class Slowness:
    """Says once how long a run will take, by the speed of its first updates.

    Only where this is more than a day, or where updates are so slow that the settings do not suit
    the machine: then another choice would save most of the time, however short the run is.
    """

    def __init__(self, trainer: "Trainer") -> None:
        self._trainer = trainer
        self._seen = trainer.progress.updates
        self._calls, self._mark = 0, (0, 0.0)
        self._over = not hasattr(trainer.config.hyper, "updates_per_step")  # on-policy ones wait

    def look(self, now: float) -> str | None:
        """The line, when it is due; `now` in seconds of any clock."""
        updates = self._trainer.progress.updates
        if self._over or updates == self._seen:
            return None
        self._seen, self._calls = updates, self._calls + 1
        if self._calls <= 2:  # the first calls compile
            self._mark = updates, now
            return None
        made, seconds = updates - self._mark[0], now - self._mark[1]
        if seconds < SAMPLE:
            return None
        self._over = True
        speed = made / seconds
        left, limit = self._left() / speed, self._limit()
        bearable = SOON if speed < SLOW else LONG
        return self._line(speed, left, limit) if min(left, limit) > bearable else None

    def _left(self) -> float:
        """Critic updates that the budget still asks for."""
        hyper: Any = self._trainer.config.hyper
        steps = self._trainer.budget - max(self._trainer.progress.step, hyper.idle_steps)
        return steps * hyper.updates_per_step

    def _limit(self) -> float:
        """Seconds that --time leaves, of which a resumed run has spent some."""
        limit = self._trainer.config.run.time
        return inf if limit is None else max(limit - self._trainer.progress.wall_seconds, 0)

    def _line(self, speed: float, seconds: float, limit: float) -> str:
        cut = f", and --time ends it after {_long(limit)}" if limit < seconds else ""
        return (
            f"at {speed:.2g} updates per second this run takes about {_long(seconds)} on this "
            f"machine{cut}; {_remedy(self._trainer.config)}; Ctrl-C saves"
        )


def _long(seconds: float) -> str:
    """A length of time in its largest unit."""
    for unit, size in (("days", 86_400.0), ("hours", 3_600.0)):
        if seconds > size:
            return f"{seconds / size:,.1f} {unit}"
    return f"{seconds / 60:.0f} minutes"


def _remedy(config: "Config") -> str:
    """What to change, the largest saving first."""
    from pacesetter.config import presets

    small = f"{config.run.algorithm}-small"
    ways = [f"train {small} instead"] if small in presets() and config.run.name != small else []
    for name in ("critic_hidden", "hidden"):
        widths = getattr(config.hyper, name, ())
        if any(width > WIDE for width in widths):
            ways.append(f"give --{name.replace('_', '-')} {' '.join([str(WIDE)] * len(widths))}")
    limits = [] if config.run.time else ["a limit such as --time 8h"]
    return ", or ".join([*ways, "fewer --steps", *limits])
