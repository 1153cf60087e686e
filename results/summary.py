"""Rebuild every table and figure that the documents quote, from the .jsonl files beside it.

python results/summary.py                           prints the tables of all studies
python results/summary.py --study pilot             of one
python results/summary.py --figures DIR             also draws the curves into DIR/STUDY.pdf
python results/summary.py --figure-2 FILE           only draws the paper's figure 2
python results/summary.py --collect pilot RUNS...   first takes finished runs into pilot.jsonl;
                                                    with --unfinished others too

`pacesetter compare results/pilot.jsonl --mixed` makes other tables of the same runs.
"""

import argparse
import json
import math
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pacesetter.runs import RunDirectory, find_all
from pacesetter.study.compare.comparison import compare
from pacesetter.study.compare.groups import Comparison
from pacesetter.study.compare.results import Run, compact, read
from pacesetter.study.report import contents, contrasts, paper, tables
from pacesetter.study.report.figures import figure_2, pdf
from pacesetter.study.report.headline import headline

HERE = Path(__file__).parent
LEVELS = (2_000, 5_000, 8_000)  # returns whose cost is shown
LEVELLED = ("frontier", "peers", "stage-2", "stage-3", "ensemble")  # for these studies
# What each study is compared at, env steps or CPU time, and with whom if not with td3.
STUDIES: dict[str, list[dict[str, str]]] = {
    "paper": [{"budget": "1M"}, {"budget": "2M", "reference": "multi-td3"}],
    "paper-table-1": [{"budget": "50k", "reference": "sac"}],
    "frontier": [
        {"budget": "100k", "reference": "td3-norm-128x2"},
        {"budget": "100k", "reference": "crossq-small"},
        {"budget": "150k", "reference": "crossq-small-bf16"},
    ],
    "pilot": [
        {"budget": "100k"},
        {"budget": "100k", "reference": "multi-td3"},
        {"budget": "200k"},
    ],
    "sunrise": [{"budget": "30k", "reference": "td3-30k"}],
    "family": [{"budget": "100k", "reference": "sac"}],
    "choices": [{"budget": "30k"}],
    "trust-region": [{"budget": "1M"}],
    "models": [{"budget": "30k"}, {"budget": "50k"}, {"cpu": "410s"}],
    "imagined": [{"budget": "45k"}],
    "precision": [{"budget": "100k"}, {"budget": "200k"}],
    "onednn": [{"budget": "100k", "reference": "td3-onednn"}],
    "walkers": [{"budget": "30k"}],
    "champions": [{"budget": "100k", "reference": "crossq-small"}],
    "humanoid": [{"budget": "776k", "reference": "multi-td3"}],
    "ensemble": [
        {"reference": "single-half"},
        {"reference": "single-ema-half"},
        {"reference": "single-ema"},
        {"reference": "none"},
    ],
    "peers": [{"budget": "100k", "reference": "sb3-td3"}],
    "stage-2": [{"budget": "100k", "reference": "td7-small-bf16"}, {"budget": "300k"}],
    "stage-3": [{"reference": "td7-small-ema-bf16"}],
    "rescue": [{"reference": "single"}],
    "cores": [{"reference": "single"}, {"reference": "none-4"}],
    "vary": [{"reference": "gamma-990"}, {"reference": "vary-none"}],
    "vary-alpha": [{"reference": "alpha-3e-4"}, {"reference": "vary-none"}],
}

PAPER = ("paper-table-1", "paper")  # the rows of its figure 2, whose curves are smoothed
SMOOTHED = 5  # evaluations; the paper does not say how many

# Studies of which every policy that was evaluated counts apart.
APART = ("ensemble", "rescue", "cores", "vary", "vary-alpha", "frontier", "stage-2", "stage-3")


def collect(study: str, folders: list[str], unfinished: bool = False) -> None:
    """Take finished runs in, one line each; a line of the same task, name and seed gives way."""
    file = HERE / f"{study}.jsonl"
    before = file.read_text("utf-8").splitlines() if file.exists() else []
    old = [json.loads(line) for line in before]
    new: dict[tuple[str, ...], dict[str, Any]] = {}
    for each in (run for folder in folders for run in find_all(folder)):
        line = compact(each)
        run = read(str(each.path), line)
        if run is None or not (run.finished or unfinished):
            print(f"left out as unfinished: {each.path}", file=sys.stderr)
            continue
        others = [*apart(each, line)] if study in APART else []
        if study == "ensemble":
            others += [halved(one) for one in (line, *others) if _name(one).startswith("single")]
        for one in others:
            read(str(each.path), one)  # which refuses what compare could not read
        for one in [line, *others]:
            if new.setdefault(_key(one), one) is not one:
                sys.exit(f"{each.path}: a run of the same task, name and seed is in {folders} too")
    table = {_key(line): line for line in old} | new
    lines = [json.dumps(table[key], separators=(",", ":")) for key in sorted(table)]
    file.write_text("".join(line + "\n" for line in lines), "utf-8")


def apart(run: RunDirectory, line: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Lines of the run's other policies, as if each were a run: `none-members` has the mean returns
    of the members alone, `none-mean` those of their mean action, `none-ema` of their EMA actors',
    and `none-champion` those of the champion where the EMA actors are what is evaluated.
    """
    rows, place = run.rows("eval"), line["columns"].index("returns")
    found = {"members": [row.get("members") for row in rows]}
    for name, key in (("mean", "members"), ("ema", "ema"), ("champion", "champion")):
        means = [row.get("mean_actions", {}).get(key) for row in rows]
        found[name] = [each and each["returns"] for each in means]
    for name, returns in found.items():
        if all(returns):
            changed = [
                [*values[:place], list(each), *values[place + 1 :]]
                for values, each in zip(line["evaluations"], returns, strict=True)
            ]
            settings = line["settings"] | {"name": f"{_name(line)}-{name}"}
            start = {"varied": line["varied"][:1]} if "varied" in line else {}
            yield line | {"settings": settings, "evaluations": changed, "selections": []} | start


def halved(line: dict[str, Any]) -> dict[str, Any]:
    """The line of a run as if it had ended at half of its steps."""
    steps, place = line["settings"]["steps"] // 2, line["columns"].index("step")
    settings = line["settings"] | {"name": f"{_name(line)}-half", "steps": steps}
    kept = [values for values in line["evaluations"] if values[place] <= steps]
    return line | {"settings": settings, "evaluations": kept}


def _name(line: dict[str, Any]) -> str:
    return line["settings"]["name"]


def _key(line: dict[str, Any]) -> tuple[str, ...]:
    keys = ("env", "env_kwargs", "wrap", "name", "seed")
    found = [line["settings"].get(key) for key in keys]  # an older line has no wrappers
    return tuple(json.dumps([] if each is None else each, sort_keys=True) for each in found)


def shown(study: str, limit: dict[str, str]) -> str:
    """The tables of a study at one place."""
    there = compare([HERE / f"{study}.jsonl"], **limit, mixed=True)
    found = [contents.details(there), contents.speed(there), *contrasts.against(there)]
    if study == "ensemble":
        found += contrasts.together(there)
    found += [*contrasts.best_of_two(there), contents.ledger(there.groups)]
    if study in LEVELLED:
        found.append(levels(there))
    if study == "trust-region" and (beside := paper.published(there)) is not None:
        found.append(beside)
    name, value = next(iter(limit.items()))
    return tables.markdown(f"{study}: {name} {value}", headline(there), there.notes, found)


def levels(there: Comparison) -> tables.Table:
    """Env steps and CPU seconds at which each seed first reached a return."""
    rows: list[list[tables.Cell]] = []
    for group in there.groups:
        row = [tables.word(group.env), tables.word(group.name)]
        for level in LEVELS:
            row.append(tables.word(", ".join(_first(run, level) for run in group.runs)))
        rows.append(row)
    return tables.Table("Return reached", ["env", "algorithm", *map(str, LEVELS)], rows)


def _first(run: Run, level: float) -> str:
    steps = run.reached(level)
    if not math.isfinite(steps):
        return "never"
    return f"{steps:,.0f} {run.cpu[run.clock == steps][0]:.0f}"


def selections(there: Comparison) -> str:
    """What each choice of a parent rested on."""
    found = contrasts.selections(there)
    return tables.markdown("Selections", headline(there), there.notes, found)


def main() -> None:
    """Print the tables of the studies, and draw the figures if asked to."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--study", choices=STUDIES, help="this one only")
    parser.add_argument("--collect", metavar=("STUDY", "RUNS"), nargs="+", help="take runs in")
    parser.add_argument("--figures", metavar="DIR", type=Path, help="where to draw curves")
    parser.add_argument("--unfinished", action="store_true", help="collect these runs too")
    parser.add_argument("--figure-2", metavar="FILE", type=Path, help="draw this, nothing else")
    found = parser.parse_args()
    if found.figure_2:
        tables_of_paper = [compare([HERE / f"{one}.jsonl"], mixed=True) for one in PAPER]
        figure_2(tables_of_paper, SMOOTHED).savefig(found.figure_2, dpi=110)
        return
    if found.collect:
        study, *folders = found.collect
        if study not in STUDIES or not folders:
            parser.error(f"--collect: a study ({', '.join(STUDIES)}), then folders of runs")
        collect(study, folders, found.unfinished)
    for study in [found.study] if found.study else STUDIES:
        if not (HERE / f"{study}.jsonl").exists():
            continue
        for limit in STUDIES[study]:
            print(shown(study, limit))
        everything = compare([HERE / f"{study}.jsonl"], mixed=True)
        if any(contrasts.selections(everything)):
            print(selections(everything))
        if found.figures:
            pdf(everything, found.figures / f"{study}.pdf")


if __name__ == "__main__":
    main()
