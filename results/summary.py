"""Collect finished runs into compact rows, and print what the documents quote of them.

python results/summary.py --collect runs    writes results/evaluations.jsonl
python results/summary.py                   prints the table
"""

import argparse
import json
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
from tabulate import tabulate

from pacesetter.runs import find_all

FILE = Path(__file__).with_name("evaluations.jsonl")
KEPT = ("updates", "member_steps", "selection_steps", "transitions", "cpu_seconds", "wall_seconds")
POINTS = (30_000, 100_000, 200_000)


def collect(folder: str) -> None:
    """One line a run: settings, versions, commit, evaluations, selections and the last ledger."""
    with FILE.open("w") as file:
        for run in find_all(folder):
            record, rows = run.record(), run.rows()
            evaluations = [[row["step"], row["returns"]] for row in rows if row["kind"] == "eval"]
            gaps = [[r["gap"], r["standard_error"]] for r in rows if r["kind"] == "select"]
            line = {**record, "evaluations": evaluations, "gaps": gaps}
            file.write(json.dumps(line | {key: rows[-1][key] for key in KEPT}) + "\n")


def at(line: dict[str, Any], step: int) -> float | None:
    """Mean of the evaluation at a step and the two before it; None if the run did not go there."""
    means = [np.mean(returns) for when, returns in line["evaluations"] if when <= step]
    reached = any(when == step for when, _ in line["evaluations"])
    return float(np.mean(means[-3:])) if reached else None


def table() -> str:
    """Per-seed and mean returns of every group of seeds, at the points that its runs reached."""
    groups: dict[tuple[str, str], list[dict[str, Any]]] = defaultdict(list)
    for line in map(json.loads, FILE.read_text().splitlines()):
        groups[line["settings"]["env"], line["settings"]["name"]].append(line)
    rows: list[list[Any]] = []
    for (env, name), lines in sorted(groups.items()):
        for step in POINTS:
            found = [value for line in lines if (value := at(line, step)) is not None]
            if found:
                seeds = " ".join(f"{value:.0f}" for value in found)
                spread = f"{np.std(found, ddof=1):.0f}" if len(found) > 1 else "-"
                rows.append([env, name, f"{step:,}", seeds, f"{np.mean(found):.0f}", spread])
    headers = ["env", "algorithm", "env steps", "each seed", "mean", "SD over seeds"]
    return tabulate(rows, headers, tablefmt="github", disable_numparse=True)


def flips() -> str:
    """How many selections were closer than one standard error."""
    lines: list[str] = []
    for line in map(json.loads, FILE.read_text().splitlines()):
        if line["gaps"]:
            close = sum(gap < error for gap, error in line["gaps"])
            run = line["settings"]
            lines.append(
                f"{run['env']} {run['name']} seed {run['seed']}: {close} of {len(line['gaps'])} "
                "selections had a gap below one standard error"
            )
    return "\n".join(lines)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--collect", metavar="RUNS")
    if folder := parser.parse_args().collect:
        collect(folder)
    print(table())
    print()
    print(flips())
