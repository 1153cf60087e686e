"""What a comparison's tables hold."""

from collections.abc import Sequence

import numpy as np

from pacesetter.study import lineage, stats
from pacesetter.study.comparison import METRICS, Comparison, Group, split
from pacesetter.study.published import scale
from pacesetter.study.stats import FEWEST_SEEDS, Array, Interval
from pacesetter.study.tables import Cell, Table, count, interval, number, spread, steps, word

LEVELS = (1_000, 2_000)
EFFECTS = (0.1, 0.2, 0.3)
SPENT = {
    "steps": "env steps",
    "updates": "updates",
    "transitions": "transitions",
    "cpu": "CPU s",
    "wall": "wall s",
}
INTERVAL = "[low; high] is the 95% interval of the mean by Student's t over seeds."


def title(comparison: Comparison) -> str:
    """What is compared, in a few words."""
    names, envs = comparison.names, comparison.envs
    tasks = ", ".join(envs) if len(envs) <= 4 else f"{len(envs)} tasks"
    return f"{' and '.join(names) if len(names) <= 3 else f'{len(names)} algorithms'} on {tasks}"


def tables(comparison: Comparison) -> list[Table]:
    """All tables that these runs can fill, the one of the metric first."""
    found = [overview(comparison), details(comparison), speed(comparison)]
    found += [*against(comparison), *together(comparison)]
    found += [*best_of_two(comparison), *selections(comparison)]
    return found


def ledger(groups: Sequence[Group], factor: int = 1) -> Table:
    """What a mean run of each group has spent, times a factor."""
    extra = list(dict.fromkeys(key for group in groups for key in group.spent if key not in SPENT))
    rows = [
        [word(group.env), word(group.name), number(len(group.runs))]
        + [number(factor * group.spent.get(key, 0)) for key in (*SPENT, *extra)]
        for group in groups
    ]
    shown = [*SPENT.values(), *(key.replace("_", " ") for key in extra)]
    return Table("Ledger: spent by a mean run", ["env", "algorithm", "runs", *shown], rows)


def overview(comparison: Comparison) -> Table:
    """The metric, one row an algorithm and one column a task; each cell says version and seeds."""
    metric = comparison.metric
    rows: list[list[Cell]] = []
    for name in comparison.names:
        row = [word(name)]
        for env in comparison.envs:
            group = comparison.find(env, name)
            found = stats.mean(group.values(metric)) if group else Interval(np.nan)
            row.append(interval(found, after=f" ({about(group)})" if group else ""))
        rows.append(row)
    title = {"final": "Final return", "auc": "Mean return of training", "max": "Maximum return"}
    notes = [f"{title[metric]}: {METRICS[metric]}. {INTERVAL}"]
    return Table(
        title[metric], ["algorithm", *comparison.envs], rows, notes, ledger(comparison.groups)
    )


def about(group: Group) -> str:
    """The small print of a cell: env version, seeds, budget, and whether it is indicative."""
    budget = " and ".join(steps(count) for count in group.budgets)
    few = ", indicative" if len(group.runs) < FEWEST_SEEDS else ""
    return f"{split(group.env)[1]}, n={len(group.runs)}, {budget}{few}"


def details(comparison: Comparison) -> Table:
    """Every metric of every group, and each seed."""
    rows: list[list[Cell]] = []
    for group in comparison.groups:
        values = group.values("final")
        rows.append(
            [
                word(group.env),
                word(group.name),
                number(len(group.runs)),
                interval(stats.mean(values)),
                number(stats.deviation(values)),
                interval(stats.iqm([values])),
                interval(stats.mean(group.values("auc"))),
                interval(stats.mean(group.values("max"))),
                word(" ".join(f"{value:.0f}" for value in values)),
            ]
        )
    headers = ["env", "algorithm", "n", "final", "SD over seeds", "IQM", "area", "max (inflated)"]
    notes = [
        f"final: {METRICS['final']}. area: {METRICS['auc']}. max: {METRICS['max']}. {INTERVAL}",
        "IQM: interquartile mean of final, with a BCa bootstrap interval from five seeds on.",
    ]
    rows = sorted(rows, key=lambda row: (row[0].text, -(row[3].key or 0)))
    return Table(
        "Each group",
        [*headers, "final of each seed"],
        rows,
        notes,
        ledger(comparison.groups),
    )


def speed(comparison: Comparison) -> Table:
    """How soon rewards come, and what a step costs."""
    rows: list[list[Cell]] = []
    for group in comparison.groups:
        row = [word(group.env), word(group.name), number(len(group.runs))]
        row += [soon(group.reached(level)) for level in LEVELS]
        cost = np.array([1_000 * run.cpu[-1] / run.steps[-1] for run in group.runs])
        rows.append([*row, interval(stats.mean(cost), 2)])
    levels = [f"env steps to {level:,}" for level in LEVELS]
    notes = [
        "Env steps to a return: the first evaluation there, after the first update; median over "
        "seeds and how many of them arrived, those that never do counting as last."
    ]
    headers = ["env", "algorithm", "n", *levels, "CPU s per 1k steps"]
    return Table("Better rewards sooner", headers, rows, notes, ledger(comparison.groups))


def soon(reached: Array) -> Cell:
    middle = float(np.sort(reached)[(len(reached) - 1) // 2])
    arrived = int(np.isfinite(reached).sum())
    return Cell(f"{number(middle).text} ({arrived} of {len(reached)})", middle)


def against(comparison: Comparison) -> list[Table]:
    """Each algorithm less the control on the same task: gap, chance to be better, seeds needed."""
    metric, rows, used = comparison.metric, list[list[Cell]](), list[Group]()
    for group in comparison.groups:
        control = comparison.find(group.env, comparison.reference)
        if control is None or control is group:
            continue
        used += [one for one in (control, group) if one not in used]
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
        f"that a run of the algorithm beats one of {comparison.reference}.",
        "Seeds: for each side, to see that gap with 80% power in a two-sided t test at 5%, if the "
        "deviations of these runs are right.",
    ]
    return [Table(f"Against {comparison.reference}", headers, rows, notes, ledger(used))]


def needed(seeds: float) -> Cell:
    return Cell(f"> {stats.MOST_SEEDS:,}", seeds) if np.isinf(seeds) else number(seeds)


def shared(comparison: Comparison) -> dict[str, list[Array]]:
    """For each algorithm its scores on the tasks that all have; empty unless there are two.

    A score is the metric over the task's scale in published.toml, so that tasks can be averaged.
    """
    envs = [
        env
        for env in comparison.envs
        if all(comparison.find(env, name) for name in comparison.names)
        and scale(split(env)[0]) is not None
    ]
    if len(envs) < 2:
        return {}
    return {
        name: [
            group.values(comparison.metric) / (scale(split(env)[0]) or 1)
            for env in envs
            if (group := comparison.find(env, name))
        ]
        for name in comparison.names
    }


def together(comparison: Comparison) -> list[Table]:
    """All shared tasks in one number an algorithm."""
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
        "Stratified bootstrap over the runs of each task, from five seeds a task on.",
    ]
    return [Table("All tasks together", headers, rows, notes, ledger(comparison.groups))]


def best_of_two(comparison: Comparison) -> list[Table]:
    """What picking the better of two independent control runs afterwards would have given."""
    rows: list[list[Cell]] = []
    used: list[Group] = []
    for env in comparison.envs:
        control = comparison.find(env, comparison.reference)
        if control is None or len(control.runs) < 2 or len(control.budgets) > 1:
            continue
        budget = control.budgets[0]
        half = control.cut(budget // 2)
        enough = min(len(run.steps) for run in half.runs) >= stats.FEWEST_EVALUATIONS
        one = stats.mean(control.values(comparison.metric))
        halves = stats.best_of_two(half.values(comparison.metric)) if enough else Interval(np.nan)
        both = stats.best_of_two(control.values(comparison.metric))
        cells = [interval(found, after=f" ({split(env)[1]})") for found in (one, halves, both)]
        rows.append([word(env), number(len(control.runs)), count(budget), *cells])
        used.append(control)
    if not rows:
        return []
    name = comparison.reference
    headers = ["env", "n", "T", f"{name} for T", "best of 2, T/2 each", "best of 2, T each"]
    notes = [
        f"Post hoc, from the finished {name} seeds: mean over all pairs of seeds of the larger "
        f"{comparison.metric} return, with a jackknife t interval. An ensemble has to beat this.",
        "T/2 each spends the ledger of one run of T; T each spends it twice.",
    ]
    return [Table("Best of two independent runs", headers, rows, notes, ledger(used))]


def selections(comparison: Comparison) -> list[Table]:
    """How sure selections were, and who descends from whom."""
    rows: list[list[Cell]] = []
    used: list[Group] = []
    for group in comparison.groups:
        chosen = [run for run in group.runs if run.selections]
        for run in chosen:
            found = lineage.Selections.of(run.selections)
            count, flips = len(found.gaps), found.flips.mean()
            rows.append(
                [
                    word(group.env),
                    word(group.name),
                    number(run.seed),
                    number(count),
                    number(float(np.median(found.ratios)), 2),
                    number(100 * flips, 0, "%"),
                    word(found.founding),
                    word(lineage.shorten(found.line)),
                ]
            )
        used += [group] if chosen else []
    if not rows:
        return []
    headers = ["env", "algorithm", "seed", "selections", "median gap / error", "coin flips"]
    headers += ["founder", "line of the champion"]
    notes = [
        "Gap: the best member's mean return less the next one's, over the standard error of such a "
        "gap. Coin flips: selections with a gap below one standard error.",
        "Founder: the member all descend from, and the selection since when. Line: the places "
        "through which the final champion descends, from the first selection to the last.",
    ]
    return [Table("Selections", headers, rows, notes, ledger(used))]


def runs(comparison: Comparison) -> Table:
    """Each run: its command and what made it."""
    rows = [
        [
            word(run.env),
            word(run.name),
            number(run.seed),
            number(run.budget),
            spread(run.metric("final"), None),
            word(run.table["command"]),
            word((run.table["commit"] or "none")[:12] + _dirty(run.table["commit"])),
            number(run.table["threads"]),
            word(run.source),
        ]
        for run in comparison.runs
    ]
    headers = ["env", "algorithm", "seed", "steps", "final", "command", "commit", "threads", "from"]
    return Table("Each run", headers, rows)


def _dirty(commit: str | None) -> str:
    return "-dirty" if commit and commit.endswith("-dirty") else ""


def made_with(comparison: Comparison) -> list[str]:
    """Versions and machines of the runs, one line each combination."""
    lines = [
        ", ".join(f"{name} {number}" for name, number in run.table["versions"].items())
        + f"; {run.table['machine']}, {run.table['threads']} threads"
        for run in comparison.runs
    ]
    return [f"{line} ({lines.count(line)} runs)" for line in dict.fromkeys(lines)]
