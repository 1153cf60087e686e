"""Rebuild every table and figure that the documents quote, from results/evaluations.jsonl.

python results/summary.py                       prints the tables
python results/summary.py --figures DIR         draws the curves into DIR/curves.pdf as well
python results/summary.py --collect RUNS...     first writes results/evaluations.jsonl from folders

`pacesetter compare results/evaluations.jsonl --mixed` makes other tables of the same file.
"""

import argparse
import json
from pathlib import Path

from pacesetter.runs import find_all
from pacesetter.study import contents, contrasts, tables
from pacesetter.study.comparison import compare
from pacesetter.study.figures import pdf
from pacesetter.study.results import compact

FILE = Path(__file__).with_name("evaluations.jsonl")
POINTS = (30_000, 100_000, 200_000)


def collect(folders: list[str]) -> None:
    """One line a run: settings, versions, commit, evaluations with their ledger, selections."""
    runs = [run for folder in folders for run in find_all(folder)]
    lines = [json.dumps(compact(run), separators=(",", ":")) for run in runs]
    FILE.write_text("".join(line + "\n" for line in lines))


def main() -> None:
    """Print the tables at each point that runs reached, and draw the figures if asked to."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--collect", metavar="RUNS", nargs="+", help="folders of finished runs")
    parser.add_argument("--figures", metavar="DIR", help="where to draw curves")
    found = parser.parse_args()
    if found.collect:
        collect(found.collect)
    for budget in POINTS:
        there = compare([FILE], budget=budget)
        shown = [contents.details(there), contents.speed(there), *contrasts.against(there)]
        print(tables.markdown(f"{budget:,} env steps", there.notes, shown))
    everything = compare([FILE], mixed=True)
    print(tables.markdown("Selections", everything.notes, contrasts.selections(everything)))
    if found.figures:
        pdf(everything, Path(found.figures) / "curves.pdf")


if __name__ == "__main__":
    main()
