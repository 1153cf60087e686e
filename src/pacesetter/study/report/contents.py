"""What the tables of groups and of single runs hold."""

from collections.abc import Sequence

import numpy as np

from pacesetter.runs.log import Row
from pacesetter.study.compare import stats
from pacesetter.study.compare.groups import METRICS, Comparison, Group, split
from pacesetter.study.compare.stats import FEWEST_EVALUATIONS, FEWEST_SEEDS, Array, Interval
from pacesetter.study.report.tables import Cell, Table, interval, number, spread, steps, word

LEVELS = (1_000, 2_000)
SPENT = {
    "steps": "env steps",
    "updates": "updates",
    "transitions": "transitions",
    "cpu": "CPU s",
    "wall": "wall s",
}
NAMES = {"final": "Final return", "auc": "Mean return of training", "max": "Maximum return"}
INTERVAL = "[low; high] is the 95% interval of the mean by Student's t over seeds."


def title(comparison: Comparison) -> str:
    """What is compared, in a few words."""
    names, envs = comparison.names, comparison.envs
    tasks = ", ".join(envs) if len(envs) <= 4 else f"{len(envs)} tasks"
    return f"{' and '.join(names) if len(names) <= 3 else f'{len(names)} algorithms'} on {tasks}"


def ledger(groups: Sequence[Group]) -> Table:
    """What a mean run of each group has spent."""
    extra = list(dict.fromkeys(key for group in groups for key in group.spent if key not in SPENT))
    rows = [
        [word(group.env), word(group.name), number(len(group.runs))]
        + [number(group.spent.get(key, 0)) for key in (*SPENT, *extra)]
        for group in groups
    ]
    shown = [*SPENT.values(), *(key.replace("_", " ") for key in extra)]
    return Table("What a mean run spent", ["env", "algorithm", "runs", *shown], rows)


def overview(comparison: Comparison) -> Table:
    """The metric, one row per algorithm, one column per task; each cell names version and seeds."""
    metric = comparison.metric
    rows: list[list[Cell]] = []
    for name in comparison.names:
        row = [word(name)]
        for env in comparison.envs:
            group = comparison.find(env, name)
            found = stats.mean(group.values(metric)) if group else Interval(np.nan)
            row.append(interval(found, after=f" ({about(group)})" if group else ""))
        rows.append(row)
    notes = [f"{NAMES[metric]}: {METRICS[metric]}. {INTERVAL}"]
    return Table(NAMES[metric], ["algorithm", *comparison.envs], rows, notes)


def about(group: Group) -> str:
    """The small print of a cell: env version, seeds, budget, and whether it is indicative."""
    budget = " and ".join(steps(count) for count in group.budgets)
    few = ", indicative" if len(group.runs) < FEWEST_SEEDS else ""
    short = ", last evaluation alone" if group.evaluations < FEWEST_EVALUATIONS else ""
    return f"{split(group.env)[1]}, n={len(group.runs)}, {budget}{few}{short}"


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
        "IQM: interquartile mean of final, with a BCa bootstrap interval from ten seeds on.",
    ]
    rows = sorted(rows, key=lambda row: (row[0].text, -(row[3].key or 0)))
    return Table("Each group", [*headers, "final of each seed"], rows, notes)


def speed(comparison: Comparison) -> Table:
    """How many env steps a return takes, and what a step costs."""
    rows: list[list[Cell]] = []
    for group in comparison.groups:
        row = [word(group.env), word(group.name), number(len(group.runs))]
        row += [soon(group.reached(level)) for level in LEVELS]
        made = np.array([run.steps[-1] or np.nan for run in group.runs])
        cost = 1_000 * np.array([run.cpu[-1] for run in group.runs]) / made
        rate = made / np.array([run.wall[-1] for run in group.runs])
        rows.append([*row, interval(stats.mean(cost), 2), interval(stats.mean(rate))])
    levels = [f"env steps to {level:,}" for level in LEVELS]
    notes = [
        "Env steps to a return: the first evaluation there, after the first update; median over "
        "seeds and how many of them arrived, those that never do counting as last. Steps/s: of the "
        "whole run by the clock on the wall, with its warm-up and evaluations."
    ]
    headers = ["env", "algorithm", "n", *levels, "CPU s per 1k steps", "env steps/s"]
    return Table("Better rewards sooner", headers, rows, notes)


def soon(reached: Array) -> Cell:
    middle = float(np.median(reached))
    arrived = int(np.isfinite(reached).sum())
    text = "never" if np.isinf(middle) else number(middle).text
    return Cell(f"{text} ({arrived} of {len(reached)})", middle)


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
            word(", ".join(dict.fromkeys(_commit(made["commit"]) for made in run.makers))),
            number(run.table["threads"]),
            word(run.source),
        ]
        for run in comparison.runs
    ]
    headers = ["env", "algorithm", "seed", "steps", "final", "command", "commit", "threads", "from"]
    return Table("Each run", headers, rows)


def _setup(made: Row) -> str:
    versions = ", ".join(f"{name} {number}" for name, number in made["versions"].items())
    return f"{versions}; {made['machine']}, {made['threads']} threads"


def _commit(full: str | None) -> str:
    return (full or "none")[:12] + ("-dirty" if full and full.endswith("-dirty") else "")


def made_with(comparison: Comparison) -> list[str]:
    """Versions and machines of the runs and of what resumed them, one line per combination."""
    lines = [
        line for run in comparison.runs for line in {_setup(made): None for made in run.makers}
    ]
    return [f"{line} ({lines.count(line)} runs)" for line in dict.fromkeys(lines)]
