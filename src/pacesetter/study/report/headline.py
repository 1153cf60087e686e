"""The result of a comparison in one sentence."""

from dataclasses import replace

import numpy as np

from pacesetter.study.compare import stats
from pacesetter.study.compare.groups import Comparison, Group
from pacesetter.study.compare.stats import Interval
from pacesetter.study.report.contents import NAMES
from pacesetter.study.report.tables import steps

MOST = 6  # algorithms that a sentence names


def headline(comparison: Comparison) -> str:
    """Who is ahead, by how much, and whether these runs can tell."""
    metric = comparison.metric
    known = [group for group in comparison.groups if _is_known(group, metric)]
    if not known:
        return f"No {NAMES[metric].lower()} is known: no evaluation came after a first update."
    unknown = [f"{x.name} on {x.env}" for x in comparison.groups if x not in known]
    more = f"; and {len(unknown) - MOST} more" if len(unknown) > MOST else ""
    rest = f" Not known, without an evaluation after the first update: {', '.join(unknown[:MOST])}"
    sentence = _sentence(replace(comparison, groups=known), comparison)
    return f"{sentence}{rest}{more}." if unknown else sentence


def _is_known(group: Group, metric: str) -> bool:
    """Whether each run has a number, and of a policy that has learned at all."""
    learned = all(run.has_learned for run in group.runs)
    return learned and bool(np.isfinite(group.values(metric)).all())


def _sentence(comparison: Comparison, every: Comparison) -> str:
    """Of the groups that are known, out of `every` one."""
    if len(comparison.groups) == 1:
        return _alone(comparison.groups[0], comparison.metric)
    if len(comparison.envs) == 1:
        return _best(comparison)
    return _tally(comparison) or _leaders(comparison, every)


def _alone(group: Group, metric: str) -> str:
    found = stats.mean(group.values(metric))
    return (
        f"{group.name} on {group.env} has a {NAMES[metric].lower()} of "
        f"{found.value:,.0f}{_within(found)} ({_made(group)})."
    )


def _best(comparison: Comparison) -> str:
    """The best algorithm of one task against the next."""
    metric = comparison.metric
    ranked = sorted(comparison.groups, key=lambda group: -_mean(group, metric))
    best, second = ranked[:2]
    gap = stats.difference(best.values(metric), second.values(metric))
    many = f" of {len(ranked)} algorithms" if len(ranked) > 2 else ""
    return (
        f"On {best.env}, {best.name} has the highest {NAMES[metric].lower()}{many}, "
        f"{_mean(best, metric):,.0f} against {_mean(second, metric):,.0f} of {second.name}"
        f"{_verdict(gap, min(len(best.runs), len(second.runs)))} "
        f"({best.name}: {_made(best)}; {second.name}: {_made(second)})."
    )


def _verdict(gap: Interval, seeds: int) -> str:
    few = f", though fewer than {stats.FEWEST_SEEDS} seeds are only indicative"
    if np.isnan(gap.low):
        return "; one run of an algorithm cannot tell this from chance"
    reach = f"the 95% interval of the difference is {gap.low:,.0f} to {gap.high:,.0f}"
    if gap.low <= 0 <= gap.high:
        return f", but these runs cannot tell the two apart: {reach}"
    return f", a difference beyond chance: {reach}{few if seeds < stats.FEWEST_SEEDS else ''}"


def _tally(comparison: Comparison) -> str:
    """On how many tasks each algorithm is ahead of the control; empty without a control."""
    counts: dict[str, list[int]] = {}
    for group in comparison.groups:
        if control := comparison.control(group):
            x, y = group.values(comparison.metric), control.values(comparison.metric)
            low, high = stats.difference(x, y)[1:]
            place = 3 if np.isnan(low) else 0 if low > 0 else 1 if high < 0 else 2
            counts.setdefault(group.name, [0, 0, 0, 0])[place] += 1
    if not counts:
        return ""
    words = [f"{name} is {_places(places)}" for name, places in [*counts.items()][:MOST]]
    more = f"; {len(counts) - MOST} more are in the table" if len(counts) > MOST else ""
    few = comparison.seeds < stats.FEWEST_SEEDS
    return (
        f"Against {comparison.reference}, by the 95% interval of the difference in "
        f"{NAMES[comparison.metric].lower()}: {'; '.join(words)}{more}"
        f"{', all indicative where seeds are few' if few else ''}."
    )


def _places(counts: list[int]) -> str:
    total = sum(counts)
    words = ("ahead", "behind", "not told apart", "of too few runs to tell")
    found = [
        f"{word} on {count} of {total} task{'s' if total > 1 else ''}"
        for word, count in zip(words, counts, strict=True)
        if count
    ]
    return " and ".join(found)


def _leaders(comparison: Comparison, every: Comparison) -> str:
    """How many tasks each algorithm leads, where no task has the control beside another."""
    metric, led = comparison.metric, dict[str, int]()
    names = {group.name for group in comparison.groups}
    if len(names) == 1:
        beside = "no other algorithm" if every.names == [*names] else "none whose return is known"
        return f"{names.pop()} was run on {len(comparison.envs)} tasks, beside {beside}."
    for env in comparison.envs:
        groups = [group for group in comparison.groups if group.env == env]
        name = max(groups, key=lambda group: _mean(group, metric)).name
        led[name] = led.get(name, 0) + 1
    ranked = sorted(led.items(), key=lambda item: -item[1])[:MOST]
    words = ", ".join(f"{name} on {count}" for name, count in ranked)
    tasks = [[group.name for group in every.groups if group.env == env] for env in every.envs]
    shared = [names for names in tasks if every.reference in names]
    if not shared:
        beside = "is not among the runs"
    elif max(map(len, shared)) == 1:
        beside = "was run beside no other"
    else:
        beside = "has no known return beside another's"
    return (
        f"The highest {NAMES[metric].lower()} of {len(comparison.envs)} tasks: {words}; "
        f"{comparison.reference} {beside}, so no difference is tested."
    )


def _mean(group: Group, metric: str) -> float:
    """Mean over seeds."""
    return float(group.values(metric).mean())


def _within(found: Interval) -> str:
    return "" if np.isnan(found.low) else f" (95% interval {found.low:,.0f} to {found.high:,.0f})"


def _made(group: Group) -> str:
    runs = len(group.runs)
    budget = " and ".join(steps(count) for count in group.budgets)
    return f"{runs} run{'s' if runs > 1 else ''} of {budget} steps"
