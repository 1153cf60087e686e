"""Runs grouped for a comparison: which may be compared, and what a reader must be told."""

import re
from collections import Counter, defaultdict
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass as checked

from pacesetter.errors import UsageError, unknown
from pacesetter.runs import FREE_PER_SEED
from pacesetter.settings import STRICT
from pacesetter.settings.validation import build
from pacesetter.settings.values import Count, Duration
from pacesetter.study.compare import stats
from pacesetter.study.compare.results import Run, gather
from pacesetter.study.compare.stats import Array

METRICS = {
    "final": "mean of the evaluations in the last 10% of the budget, and of at least three",
    "auc": "area under the curve of evaluations, divided by the env steps it spans",
    "max": "largest evaluation after the first update; inflated, as a maximum of noisy values is",
}
CONTROL = "td3"
ANT = "pacesetter/Ant111"
# `train` lets the horizon follow from --steps; compared, another horizon is another algorithm.
_FREE = FREE_PER_SEED - {"replay_horizon", "lr_horizon"}
_SPENT = ("steps", "updates", "transitions", "cpu", "wall")


@checked(frozen=True, config=STRICT)
class Limit:
    """What `--budget` and `--cpu` take: env steps, or seconds of the processor."""

    budget: Count | None = Field(None, ge=1)
    cpu: Duration | None = Field(None, gt=0)

    def __str__(self) -> str:
        return f"{self.budget:,} env steps" if self.budget else f"{self.cpu:,.0f} CPU seconds"


@dataclass(frozen=True)
class Group:
    """Runs of one algorithm on one task that differ by seed."""

    env: str
    name: str
    runs: list[Run]

    def values(self, metric: str) -> Array:
        return np.array([run.metric(metric) for run in self.runs])

    def reached(self, level: float) -> Array:
        return np.array([run.reached(level) for run in self.runs])

    @cached_property
    def spent(self) -> dict[str, float]:
        """Ledger of a mean run; what only some algorithms count comes after what all do."""
        table = {key: np.mean([getattr(run, key)[-1] for run in self.runs]) for key in _SPENT}
        for key in sorted({key for run in self.runs for key in run.extra}):
            spent = [run.extra[key][-1] if key in run.extra else 0 for run in self.runs]
            table[key] = np.mean(spent)
        return {key: float(value) for key, value in table.items()}

    @property
    def budgets(self) -> list[int]:
        return sorted({run.budget for run in self.runs})

    def cut(self, budget: int) -> "Group":
        return Group(self.env, self.name, [run.cut(budget) for run in self.runs])


@dataclass(frozen=True)
class Comparison:
    """The groups, the metric, the control, and what a reader must be told."""

    groups: list[Group]
    metric: str
    reference: str
    notes: list[str]

    @property
    def envs(self) -> list[str]:
        return list(dict.fromkeys(group.env for group in self.groups))

    @property
    def names(self) -> list[str]:
        """Algorithms, the control first."""
        names = sorted({group.name for group in self.groups})
        return sorted(names, key=lambda name: name != self.reference)

    @property
    def runs(self) -> list[Run]:
        return [run for group in self.groups for run in group.runs]

    @property
    def budget(self) -> int | None:
        """Env steps of every run, None if they are mixed."""
        budgets = {run.budget for run in self.runs}
        return budgets.pop() if len(budgets) == 1 else None

    def find(self, env: str, name: str) -> Group | None:
        return next((g for g in self.groups if (g.env, g.name) == (env, name)), None)


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
    found, empty = gather(runs, below)
    kept, notes = _complete(found, empty, limit)
    _refuse_twins(kept)
    notes += _mixtures(kept, mixed, limit)
    kept.sort(key=lambda run: (run.env, run.name, run.seed, run.budget))
    grouped = groupby(kept, lambda run: (run.env, run.name))
    groups = [Group(env, name, list(same)) for (env, name), same in grouped]
    return Comparison(groups, metric, reference, notes + _remarks(groups, kept, limit))


def split(env: str) -> tuple[str, str]:
    """A task without its version, and the version; the Ant with 111 observations is an Ant."""
    if env.startswith(ANT):
        task, version = split(env.replace(ANT, "Ant", 1))
        return task, f"{version}, 111"
    found = re.fullmatch(r"(.*)-(v\d+)(.*)", env)
    return (found[1] + found[3], found[2]) if found else (env, "-")


def _complete(found: list[Run], empty: list[str], limit: Limit) -> tuple[list[Run], list[str]]:
    """The runs that made their budget, cut at the limit, and a note for those that did not."""
    kept: list[Run] = []
    out = [f"{source} (no evaluation)" for source in empty]
    for run in found:
        if short := _short_of(run, limit):
            out.append(f"{run.source} ({short})")
            continue
        if limit.cpu:
            run = run.within(limit.cpu)
        elif limit.budget:
            run = run.cut(limit.budget)
        if len(run.steps) < stats.FEWEST_EVALUATIONS:
            out.append(f"{run.source} ({len(run.steps)} evaluations, three are needed)")
        else:
            kept.append(run)
    if not kept:
        reason = f": {'; '.join(out[:3])}" if out else ""
        raise UsageError(f"run: none is complete{reason}; limit all with --budget, or resume them")
    return kept, [f"Left out as incomplete: {', '.join(out)}."] if out else []


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
        key = (run.env, run.name, run.seed, run.budget)
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
    if len(budgets) > 1 and not limit.cpu:
        shown = ", ".join(f"{budget:,}" for budget in budgets)
        faults.append(f"budget: runs of {shown} env steps; --budget limits all to one")
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
            a, b = other.settings[key], run.settings[key]
            if a != b:
                faults[run.env, run.name, key] = f"{run.env} {run.name} has {key} {a} and {b}"
    return list(faults.values())


def _remarks(groups: list[Group], runs: list[Run], limit: Limit) -> list[str]:
    """Notes on what is no reason to refuse."""
    notes: list[str] = []
    few = [group for group in groups if len(group.runs) < stats.FEWEST_SEEDS]
    if few:
        names = _few([f"{group.env} {group.name} (n={len(group.runs)})" for group in few])
        notes.append(f"Indicative only, for fewer than {stats.FEWEST_SEEDS} seeds: {names}.")
    if limit.budget or limit.cpu:
        notes.append(f"Every run counts up to {limit}.")
    if any(run.settings.get("count_selection_steps") is False for run in runs):
        notes.append("Steps of selection come on top of the env steps where a run left them out.")
    for key, what in (("eval_every", "evaluations come at"), ("eval_episodes", "episodes differ")):
        if len({run.settings[key] for run in runs}) > 1:
            notes.append(f"Settings of the evaluation differ ({key}): {what} other numbers.")
    for key, what in (("threads", "thread counts"), ("machine", "machines")):
        if len({str(run.table[key]) for run in runs}) > 1:
            notes.append(f"The runs had several {what}: compare no CPU or wall seconds.")
    commits = Counter(str(run.table["commit"]) for run in runs)
    if len(commits) > 1:
        notes.append(f"The runs come from {len(commits)} commits; the last table lists them.")
    return notes


def _few(words: list[str], most: int = 6) -> str:
    rest = f" and {len(words) - most} more" if len(words) > most else ""
    return ", ".join(words[:most]) + rest
