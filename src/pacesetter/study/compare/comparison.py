"""A comparison of runs: which may be compared, and what a reader must be told."""

import re
from collections import defaultdict
from collections.abc import Iterable
from itertools import groupby
from pathlib import Path
from typing import Any

from pydantic import Field
from pydantic.dataclasses import dataclass as checked

from pacesetter.errors import UsageError, unknown
from pacesetter.runs import FREE_PER_SEED
from pacesetter.runs.directory import HORIZONS
from pacesetter.runs.log import Row
from pacesetter.settings import STRICT
from pacesetter.settings.ensemble import WINDOWS
from pacesetter.settings.validation import build
from pacesetter.settings.values import Count, Duration
from pacesetter.study.compare import stats
from pacesetter.study.compare.gathering import Gathered, gather
from pacesetter.study.compare.groups import CONTROL, METRICS, Comparison, Group, split
from pacesetter.study.compare.results import Run

# `train` lets the horizon follow from --steps; compared, another horizon is another algorithm.
_FREE = FREE_PER_SEED - HORIZONS
EVALUATION = {  # settings of it, and what is true where they differ
    "eval_every": "evaluations come at other numbers of steps",
    "eval_episodes": "a mean is of more episodes in some runs than in others",
    "eval_policy": "some runs evaluate the champion, some the mean of EMA actors",
}
MACHINES = {  # what decides CPU seconds
    "threads": "thread counts",
    "machine": "machines",
    "backend": "kinds of device",
    "products": "libraries of matrix products",
}


@checked(frozen=True, config=STRICT)
class Limit:
    """What `--budget` and `--cpu` take: env steps, or seconds of the processor."""

    budget: Count | None = Field(None, ge=1)
    cpu: Duration | None = Field(None, gt=0)

    def __str__(self) -> str:
        return f"{self.budget:,} env steps" if self.budget else f"{self.cpu:,.0f} CPU seconds"


def compare(
    runs: Iterable[str | Path],
    *,
    below: str | Path = "runs",
    metric: str = "final",
    budget: int | str | None = None,
    cpu: float | str | None = None,
    reference: str = CONTROL,
    mixed: bool = False,
) -> Comparison:
    """Group runs by env and name, refusing what no table should mix unless `mixed` is set.

    `runs` are folders, tails or patterns of runs below a folder, or files of results. With a
    budget, or with CPU time, each run counts up to it only. Raises UsageError.
    """
    if metric not in METRICS:
        raise unknown("metric", metric, METRICS)
    if budget is not None and cpu is not None:
        raise UsageError("cpu: limits runs otherwise than --budget does; give one of the two")
    limit = build(Limit, {"budget": budget, "cpu": cpu})
    found = gather(runs, below)
    kept, notes = _complete(found, limit)
    _refuse_twins(kept)
    notes += _mixtures(kept, mixed, limit)
    kept.sort(key=lambda run: (run.env, run.name, run.seed, run.budget))
    grouped = groupby(kept, lambda run: (run.env, run.name))
    groups = [Group(env, name, list(same)) for (env, name), same in grouped]
    notes += _remarks(groups, kept, limit)
    if reference != CONTROL and reference not in {run.name for run in kept}:
        notes.append(f"No algorithm {reference} is among the runs, so none is compared with it.")
    return Comparison(groups, metric, reference, notes, found.damaged)


def _complete(found: Gathered, limit: Limit) -> tuple[list[Run], list[str]]:
    """The runs that made their budget, cut at the limit, and notes on those that are left out."""
    kept: list[Run] = []
    out = [f"{source} (no evaluation)" for source in found.empty]
    for run in found.runs:
        if short := _short_of(run, limit):
            out.append(f"{run.source} ({short})")
            continue
        if limit.cpu:
            run = run.within(limit.cpu)
        elif limit.budget:
            run = run.cut(limit.budget)
        if run.steps.size:
            kept.append(run)
        else:
            out.append(f"{run.source} (no evaluation up to {limit})")
    if not kept and found.damaged and not out:
        raise UsageError(f"run: none can be read: {'; '.join(found.damaged[:3])}")
    if not kept:
        few = [*out[:3], *found.damaged[:3]]
        reason = f": {'; '.join(few)}" if few else ""
        raise UsageError(f"run: none is complete{reason}; limit all with --budget, or resume them")
    notes = [f"Left out as incomplete: {', '.join(out)}."] if out else []
    return kept, notes + [f"Left out: {why}." for why in found.damaged]


def _short_of(run: Run, limit: Limit) -> str | None:
    """How far a run came that did not reach the limit, or without one its own budget."""
    if limit.cpu:
        return None if run.cpu[-1] >= limit.cpu else f"{run.cpu[-1]:,.0f} of {limit}"
    aim, at = limit.budget or run.planned, int(run.clock[-1])
    enough = at >= limit.budget if limit.budget else run.finished
    return None if enough else f"{at:,} of {aim:,} env steps"


def _refuse_twins(runs: list[Run]) -> None:
    seen: dict[tuple[Any, ...], Run] = {}
    for run in runs:
        key = (run.env, run.name, run.seed)
        if key in seen:
            raise UsageError(
                f"run: {seen[key].source} and {run.source} are both {run.env} {run.name} "
                f"seed {run.seed}; seeds must differ, other variants need their own --name"
            )
        seen[key] = run


def _mixtures(runs: list[Run], mixed: bool, limit: Limit) -> list[str]:
    """Refuse several versions of a task, several budgets, or settings that differ in a group."""
    faults: list[str] = []
    versions: dict[str, set[str]] = defaultdict(set)
    for run in runs:
        versions[split(run.env)[0]].add(split(run.env)[1])
    for task, several in versions.items():
        if len(several) > 1:
            faults.append(f"env: {task} in the versions {', '.join(sorted(several))}")
    budgets = sorted({run.budget for run in runs})
    # The last evaluations up to a limit may lie apart, by less than a final return spans.
    near = limit.budget and min(budgets) >= 0.9 * limit.budget
    if len(budgets) > 1 and not (near or limit.cpu):
        shown = ", ".join(f"{budget:,}" for budget in budgets)
        faults.append(
            f"budget: runs of {shown} env steps; --budget {budgets[0]} takes each up to it"
        )
    faults += _differing(runs)
    if faults and not mixed:
        raise UsageError(f"{'; '.join(faults)}; --mixed compares them anyway and says so")
    return [f"Mixed, so no fair comparison: {line}." for line in faults]


def _differing(runs: list[Run]) -> list[str]:
    first: dict[tuple[str, str], Run] = {}
    faults: dict[tuple[str, str, str], str] = {}
    for run in runs:
        other = first.setdefault((run.env, run.name), run)
        # A setting that an older version did not have is not a difference.
        for key in sorted((run.settings.keys() & other.settings.keys()) - _FREE):
            a, b = _in_force(other.settings, key), _in_force(run.settings, key)
            if a != b:
                faults[run.env, run.name, key] = f"{run.env} {run.name} has {key} {a} and {b}"
    return list(faults.values())


def _in_force(settings: Row, key: str) -> Any:
    """The value of a setting; for None, the default that other settings give it."""
    if settings[key] is None and key == "select_window":
        return WINDOWS.get(settings.get("rule", ""), 1)
    if settings[key] is None and key == "select_after":
        return settings.get("warmup")
    return settings[key]


def _remarks(groups: list[Group], runs: list[Run], limit: Limit) -> list[str]:
    """Notes on what is no reason to refuse."""
    return [*_thin(groups, runs), *_counted_apart(runs, limit), *_made_apart(runs)]


def _thin(groups: list[Group], runs: list[Run]) -> list[str]:
    """Notes on groups and runs that say little."""
    notes: list[str] = []
    few = [group for group in groups if len(group.runs) < stats.FEWEST_SEEDS]
    if few:
        names = _few([f"{group.env} {group.name} (n={len(group.runs)})" for group in few])
        notes.append(f"Indicative only, for fewer than {stats.FEWEST_SEEDS} seeds: {names}.")
    if idle := [_called(run) for run in runs if not run.has_learned]:
        notes.append(
            "Made no update, so their numbers are those of the policies that they began with, and "
            f"the first sentence ranks none of them: {_few(idle)}."
        )
    counted = [(run, int(run.counted.sum())) for run in runs]
    short = [(run, many) for run, many in counted if many < stats.FEWEST_EVALUATIONS]
    if short:
        names = _few([f"{_called(run)} ({many})" for run, many in short])
        notes.append(
            f"Fewer than {stats.FEWEST_EVALUATIONS} evaluations after the first update, so the "
            f"last one counts alone: {names}. A smaller --eval-every gives more."
        )
    return notes


def _counted_apart(runs: list[Run], limit: Limit) -> list[str]:
    """Notes on what counts in one run and not in another."""
    limited = limit.budget or limit.cpu
    notes = [f"Every run counts up to {limit}."] if limited else []
    if any(run.settings.get("count_selection_steps") is False for run in runs):
        notes.append("Steps of selection come on top of the env steps where a run left them out.")
    for key, what in EVALUATION.items():
        if len({run.settings.get(key) for run in runs}) > 1:
            notes.append(f"Settings of the evaluation differ ({key}): {what}.")
    return notes + (_unfinished_schedules(runs) if limited else [])


def _made_apart(runs: list[Run]) -> list[str]:
    """Notes on machines and versions that differ."""
    notes: list[str] = []
    makers = [made for run in runs for made in run.makers]
    for key, what in MACHINES.items():
        # What an older version did not record is not a difference.
        if len({str(made[key]) for made in makers if _is_told(made, key)}) > 1:
            notes.append(f"The runs had several {what}: compare no CPU or wall seconds.")
    commits = {str(made["commit"]) for made in makers}
    if len(commits) > 1:
        notes.append(f"The runs come from {len(commits)} commits; the last table lists them.")
    return notes


def _is_told(made: Row, key: str) -> bool:
    """Whether it is on record; older versions named no processor."""
    value = made.get(key)
    return value is not None and not (key == "machine" and re.fullmatch(r"\w+, \d+ cores", value))


def _unfinished_schedules(runs: list[Run]) -> list[str]:
    """A note on runs that are cut within a schedule that was meant for a longer run."""
    within = [
        _called(run)
        for run in runs
        if any((run.settings.get(key) or 0) > run.settings["steps"] for key in HORIZONS)
    ]
    if not within:
        return []
    return [
        "Cut before their schedule (learning rate, importance of the replay) has ended, so a run "
        f"of this budget would differ: {_few(within)}."
    ]


def _called(run: Run) -> str:
    return f"{run.env} {run.name} seed {run.seed}"


def _few(words: list[str], most: int = 6) -> str:
    rest = f" and {len(words) - most} more" if len(words) > most else ""
    return ", ".join(words[:most]) + rest
