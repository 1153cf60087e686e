"""One's own returns beside the paper's tables I and II, and beside published ones."""

from collections.abc import Iterator

import numpy as np

from pacesetter.study.compare import stats
from pacesetter.study.compare.groups import METRICS, Comparison, Group, split
from pacesetter.study.report.contents import about
from pacesetter.study.report.published import Source, sources
from pacesetter.study.report.tables import Cell, Table, count, number, spread, steps, word

TASKS = ("Ant", "HalfCheetah", "Walker2d")  # the paper's, in the order of its tables
PAPER = {"I": ("multi-td3", "sunrise"), "II": ("multi-td3", "td3")}
CURVE_BUDGET = 1_000_000


def tables(comparison: Comparison) -> list[Table]:
    """Tables I and II as far as there are runs for them, then all published returns."""
    found = [paper_table(comparison, which) for which in PAPER]
    return [table for table in [*found, published(comparison)] if table is not None]


def paper_table(comparison: Comparison, which: str) -> Table | None:
    """One of the paper's tables with its own rows, ours, and published ones of the algorithm."""
    groups = [
        group
        for group in comparison.groups
        if group.name in PAPER[which] and split(group.env)[0] in TASKS
    ]
    if not groups:
        return None
    rows: list[list[Cell]] = []
    for name in PAPER[which]:
        printed = [one for one in sources() if one["algorithm"] == name]
        rows += [_printed(one) for one in printed if one.get("table") == which]
        rows += list(_ours(groups, name))
        rows += [_printed(one) for one in printed if which == "II" and _on_tasks(one)]
    notes = [
        "Each cell: mean ± standard deviation (env version, seeds, budget). "
        f"Ours, final: {METRICS['final']}. Ours, max: {METRICS['max']}. It is the paper's kind of "
        "number, and the final return is ours.",
        "The paper's budget is ambiguous (its tables say episodes, its figure time steps), and so "
        "is what its standard deviation is over. Rows of different env versions, budgets or "
        "metrics do not measure the same thing.",
    ]
    title = f"The paper's table {which}"
    return Table(title, ["algorithm", "source", *TASKS], rows, notes)


def _on_tasks(source: Source) -> bool:
    """Whether a source is beside the paper's table: one budget, and at least one of its tasks."""
    return "budget" in source and any(task in source["returns"] for task in TASKS)


def _printed(source: Source) -> list[Cell]:
    who = Cell(f"{source['who']}, {source['metric']}", url=source.get("url", ""))
    row = [word(source["algorithm"]), who]
    said = source.get("said") or steps(source["budget"])
    seeds = f", n={source['seeds']}" if "seeds" in source else ""
    for task in TASKS:
        values = source["returns"].get(task)
        after = f" ({source['version']}{seeds}, {said})"
        row.append(_spread(values, after) if values else word("-"))
    return row


def _spread(values: list[float], after: str) -> Cell:
    """As printed, without a digit more."""
    return Cell(" ± ".join(f"{value:,}" for value in values) + after, values[0])


def _ours(groups: list[Group], name: str) -> Iterator[list[Cell]]:
    """A row for each env version and metric."""
    named = [group for group in groups if group.name == name]
    for version in sorted({split(group.env)[1] for group in named}):
        by_task = {split(group.env)[0]: group for group in named if split(group.env)[1] == version}
        for metric in ("final", "max"):
            row = [word(name), word(f"ours, {metric}{' (inflated)' if metric == 'max' else ''}")]
            for task in TASKS:
                group = by_task.get(task)
                row.append(_mean(group, metric, f" ({about(group)})") if group else word("-"))
            yield row


def _mean(group: Group, metric: str, after: str) -> Cell:
    values = group.values(metric)
    return spread(float(values.mean()), stats.deviation(values), after)


def published(comparison: Comparison) -> Table | None:
    """What others report on these tasks, beside the groups; a learning curve at our budget."""
    rows: list[list[Cell]] = []
    found: list[str] = []
    for group in comparison.groups:
        task, version = split(group.env)
        if any(task in source["returns"] for source in sources()):
            row = [_mean(group, comparison.metric, f" ({version})")]
            row += [word(f"{comparison.metric}, seeds"), number(len(group.runs))]
            budget = count(group.budgets[0]) if len(group.budgets) == 1 else word("mixed")
            rows.append([word(task), word(group.name), *row, budget, word("ours")])
            found.append(task)
    for task in dict.fromkeys(found):
        rows += [row for source in sources() for row in _rows(source, task, comparison.budget)]
    if not found:
        return None
    headers = ["task", "algorithm", "return (env version)", "metric, ± over"]
    headers += ["n", "steps", "source"]
    notes = [
        "Published numbers with the env version, budget and metric of their source. Only "
        "HalfCheetah has the same dynamics from v2 to v5; a maximum is inflated, a training return "
        "has noise in it, and a standard deviation over episodes of one agent says nothing about "
        "seeds."
    ]
    rows = sorted(rows, key=lambda row: (row[0].text, row[6].text != "ours"))
    return Table("Published returns", headers, rows, notes)


def _rows(source: Source, task: str, budget: int | None) -> Iterator[list[Cell]]:
    if task not in source["returns"] or "said" in source:
        return
    values = source["returns"][task]
    at: int = source.get("budget") or CURVE_BUDGET
    if "budgets" in source:  # a curve, of which we show our budget if it is there
        at = budget if budget is not None and budget in source["budgets"] else at
        values = values[source["budgets"].index(at)]
    over = f", {source['spread']}" if "spread" in source else ""
    yield [
        word(task),
        word(source["algorithm"]),
        _spread(values, f" ({source['version']})"),
        word(f"{source['metric']}{over}"),
        number(source.get("seeds", np.nan)),
        count(at),
        Cell(source["cite"], url=source.get("url", "")),
    ]
