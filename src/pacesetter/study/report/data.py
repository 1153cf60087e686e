"""A comparison as data for other programs: JSON with everything, CSV with a row per group."""

import csv
from collections.abc import Iterator
from io import StringIO
from math import isfinite
from typing import Any

from pacesetter import storage
from pacesetter.study.compare import stats
from pacesetter.study.compare.groups import METRICS, Comparison, Group
from pacesetter.study.compare.results import AXES, Run
from pacesetter.study.report.curves import spending
from pacesetter.study.report.headline import headline


def as_json(comparison: Comparison) -> str:
    """The result, the notes, each group's statistics and ledger, and each run's evaluations."""
    table = {
        "result": headline(comparison),
        "metric": comparison.metric,
        "reference": comparison.reference,
        "notes": comparison.notes,
        "groups": [_group(comparison, group) for group in comparison.groups],
    }
    return storage.as_json(table, indent=1) + "\n"


def as_csv(comparison: Comparison) -> str:
    """A row per group: its runs, each metric with its interval, the difference, the ledger."""
    rows = [dict(_columns(comparison, group)) for group in comparison.groups]
    columns = dict.fromkeys(key for row in rows for key in row)
    text = StringIO()
    writer = csv.DictWriter(text, list(columns), restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows({key: _known(value) for key, value in row.items()} for row in rows)
    return text.getvalue()


def _group(comparison: Comparison, group: Group) -> dict[str, Any]:
    return {
        "env": group.env,
        "algorithm": group.name,
        "budgets": group.budgets,
        "metrics": {metric: _metric(group, metric) for metric in METRICS},
        "difference": _difference(comparison, group),
        "ledger": group.spent,
        "runs": [_run(run) for run in group.runs],
    }


def _metric(group: Group, metric: str) -> dict[str, Any]:
    values = group.values(metric)
    return stats.mean(values)._asdict() | {
        "sd": stats.deviation(values),
        "iqm": stats.iqm([values]),
    }


def _difference(comparison: Comparison, group: Group) -> dict[str, Any] | None:
    """Against the control on the same task; None for the control and where there is none."""
    control = comparison.control(group)
    if control is None:
        return None
    x, y = group.values(comparison.metric), control.values(comparison.metric)
    return stats.difference(x, y)._asdict() | {"p_better": stats.improvement([(x, y)]).value}


def _run(run: Run) -> dict[str, Any]:
    spent = {axis: spending(run, axis).tolist() for axis in AXES}
    return {
        "seed": run.seed,
        "from": run.source,
        "command": run.table["command"],
        "commit": run.table["commit"],
        **{metric: run.metric(metric) for metric in METRICS},
        "evaluations": {**spent, "return": run.returns.tolist()},
    }


def _columns(comparison: Comparison, group: Group) -> Iterator[tuple[str, Any]]:
    yield from (("env", group.env), ("algorithm", group.name), ("runs", len(group.runs)))
    yield "budget", " ".join(map(str, group.budgets))
    for metric in METRICS:
        found = _metric(group, metric)
        yield metric, found["value"]
        yield from ((f"{metric}_{key}", found[key]) for key in ("low", "high", "sd"))
    difference = _difference(comparison, group) or {}
    for key in ("value", "low", "high", "p_better"):
        yield "difference" if key == "value" else f"difference_{key}", difference.get(key)
    yield from group.spent.items()


def _known(value: Any) -> Any:
    """CSV has no NaN: nothing stands there."""
    return None if isinstance(value, float) and not isfinite(value) else value
