"""What the tables of contrasts hold: against a control, over all tasks, and among members."""

import numpy as np

from pacesetter.runs.directory import HORIZONS
from pacesetter.study.compare import lineage, stats
from pacesetter.study.compare.groups import Comparison, split
from pacesetter.study.compare.stats import Array, Interval
from pacesetter.study.report.published import scale
from pacesetter.study.report.tables import Cell, Table, count, interval, number, word

EFFECTS = (0.1, 0.2, 0.3)


def against(comparison: Comparison) -> list[Table]:
    """Each algorithm less the control on the same task: gap, chance to be better, seeds needed."""
    metric, rows = comparison.metric, list[list[Cell]]()
    for group in comparison.groups:
        control = comparison.control(group)
        if control is None:
            continue
        x, y = group.values(metric), control.values(metric)
        gap, deviations = stats.difference(x, y), (stats.deviation(x), stats.deviation(y))
        percent = 100 * gap.value / abs(y.mean()) if y.mean() else np.nan
        row = [word(group.env), word(group.name), interval(gap), number(percent, 1, "%")]
        row += [interval(stats.improvement([(x, y)]), 2)]
        wanted = [gap.value, *(effect * abs(y.mean()) for effect in EFFECTS)]
        rows.append(row + [needed(stats.seeds_needed(one, deviations)) for one in wanted])
    if not rows:
        return []
    headers = ["env", "algorithm", "difference", "in percent", "P(better)", "seeds for this gap"]
    headers += [f"for {effect:.0%}" for effect in EFFECTS]
    notes = [
        f"Difference of the mean {metric} return with Welch's 95% t interval; P(better): chance "
        f"that a run of the algorithm beats one of {comparison.reference}, given from "
        f"{stats.FEWEST_CHANCES} runs a side on.",
        "Seeds: for each side, to see that gap with 80% power in a two-sided t test at 5%, if the "
        "standard deviations of these runs are right.",
    ]
    return [Table(f"Against {comparison.reference}", headers, rows, notes)]


def needed(seeds: float) -> Cell:
    return Cell(f"> {stats.MOST_SEEDS:,}", seeds) if np.isinf(seeds) else number(seeds)


def shared(comparison: Comparison) -> dict[str, list[Array]]:
    """For each algorithm its scores on the tasks that all have; empty unless there are two.

    A score is the metric over the task's scale in published.toml, so that tasks can be averaged.
    """
    scales = {
        env: one
        for env in comparison.envs
        if all(comparison.find(env, name) for name in comparison.names)
        and (one := scale(split(env)[0])) is not None
    }
    if len(scales) < 2:
        return {}
    return {
        name: [
            group.values(comparison.metric) / one
            for env, one in scales.items()
            if (group := comparison.find(env, name))
        ]
        for name in comparison.names
    }


def together(comparison: Comparison) -> list[Table]:
    """All shared tasks in one number per algorithm."""
    scores = shared(comparison)
    control = scores.get(comparison.reference)
    rows: list[list[Cell]] = []
    for name, tasks in scores.items():
        row = [word(name), number(len(tasks)), number(sum(map(len, tasks)))]
        row.append(interval(stats.iqm(tasks), 3))
        if control is not None:
            better = name != comparison.reference
            pairs = list(zip(tasks, control, strict=True))
            row.append(interval(stats.improvement(pairs), 2) if better else word("-"))
        rows.append(row)
    if not rows:
        return []
    headers = ["algorithm", "tasks", "runs", "IQM of scores"]
    headers += [f"P(better than {comparison.reference})"] if control is not None else []
    notes = [
        f"Score: {comparison.metric} return over the published return of TD3 on that task after 1M "
        "steps (published.toml), only to bring tasks to one scale; it is of other env versions.",
        "Stratified bootstrap over the runs of each task: of the IQM from ten seeds per task on, "
        "of P(better) from ten runs a side over all tasks on.",
    ]
    return [Table("All tasks together", headers, rows, notes)]


def best_of_two(comparison: Comparison) -> list[Table]:
    """What the better of two independent control runs, picked afterwards, would have scored."""
    rows: list[list[Cell]] = []
    for env in comparison.envs:
        control = comparison.find(env, comparison.reference)
        if control is None or len(control.runs) < 2 or len(control.budgets) > 1:
            continue
        budget = control.budgets[0]
        half = control.cut(budget // 2)
        enough = min(len(run.steps) for run in half.runs) >= stats.FEWEST_EVALUATIONS
        enough = enough and half.budgets == [budget // 2]  # else no evaluation was there
        enough = enough and all(run.has_learned for run in half.runs)
        # Half a run is no run of half the budget where a schedule was meant for the whole.
        enough = enough and not any(run.settings.get(key) for run in half.runs for key in HORIZONS)
        one = stats.mean(control.values(comparison.metric))
        halves = stats.best_of_two(half.values(comparison.metric)) if enough else Interval(np.nan)
        both = stats.best_of_two(control.values(comparison.metric))
        cells = [interval(found, after=f" ({split(env)[1]})") for found in (one, halves, both)]
        rows.append([word(env), number(len(control.runs)), count(budget), *cells])
    if not rows:
        return []
    name = comparison.reference
    headers = ["env", "n", "T", f"{name} for T", "best of 2, T/2 each", "best of 2, T each"]
    notes = [
        f"Post hoc, from the finished {name} seeds: mean over all pairs of seeds of the larger "
        f"{comparison.metric} return, with a jackknife t interval. An ensemble has to beat this.",
        "T/2 each costs what one run of T does; T each costs twice as much.",
    ]
    return [Table("Best of two independent runs", headers, rows, notes)]


def selections(comparison: Comparison) -> list[Table]:
    """How sure selections were, and who descends from whom."""
    rows: list[list[Cell]] = []
    for group in comparison.groups:
        for run in (run for run in group.runs if run.selections):
            found = lineage.Selections.of(run.selections)
            rows.append(
                [
                    word(group.env),
                    word(group.name),
                    number(run.seed),
                    number(len(found.gaps)),
                    number(float(np.median(found.ratios)), 2),
                    number(100 * found.flips.mean(), 0, "%"),
                    word(found.founding),
                    word(lineage.shorten(found.line)),
                ]
            )
    if not rows:
        return []
    headers = ["env", "algorithm", "seed", "selections", "median gap / error", "coin flips"]
    headers += ["founder", "line of the champion"]
    notes = [
        "Gap: the best member's mean return less the next one's, over the standard error of such a "
        "gap. Coin flips: selections with a gap below one standard error. Where one episode per "
        "member decides, the error is their own spread, so most gaps of two members are below it.",
        "Founder: the member all descend from, and the selection since when. Line: the places "
        "through which the final champion descends, from the first selection to the last.",
    ]
    return [Table("Selections", headers, rows, notes)]


def settings(comparison: Comparison) -> list[Table]:
    """Members that differ: what they began with, and how the champion's settings came to be."""
    rows: list[list[Cell]] = []
    for group in comparison.groups:
        for run in (run for run in group.runs if run.varied and run.selections):
            found = lineage.Selections.of(run.selections)
            for name, first in run.varied[0].items():
                line = lineage.settings_along(found, run.varied, name)
                rows.append(
                    [
                        word(group.env),
                        word(group.name),
                        number(run.seed),
                        word(name),
                        word(" ".join(map(str, first))),
                        word(lineage.shorten(line)),
                        word(" ".join(map(str, run.varied[-1][name]))),
                    ]
                )
    if not rows:
        return []
    headers = ["env", "algorithm", "seed", "setting", "members at the start"]
    headers += ["line of the champion", "members at the end"]
    notes = [
        "Line: the setting's value where the final champion descends from, before each selection "
        "and at the end."
    ]
    return [Table("Settings of members", headers, rows, notes)]
