"""The verb `list`: what there is, as lines or as JSON."""

import inspect
from collections.abc import Callable
from textwrap import fill
from typing import Any

from tabulate import tabulate

from pacesetter.cli.flags import parser
from pacesetter.cli.show import evaluations, state
from pacesetter.errors import UsageError, unknown
from pacesetter.runs import Row, find_all
from pacesetter.storage import FAULTS, as_json
from pacesetter.text import printable

WIDTH = 88  # columns of a paragraph


def list_(words: list[str]) -> int:
    """List algorithms, envs, rules, presets, suites, champions or runs."""
    command = parser("list", "List what there is: everything by name, or one kind in full.")
    kinds = [*LISTS, "runs"]
    about = "what to list in full (default everything, by name)"
    command.add_argument("kind", nargs="?", metavar="|".join(kinds), help=about)
    command.add_argument("--json", action="store_true", help="print a list of objects as JSON")
    command.add_runs()
    found = command.parse(words)
    if found.kind is not None and found.kind not in kinds:
        raise unknown("list", found.kind, kinds)
    lists = LISTS | {"runs": lambda: runs(found.runs)}
    if found.json:
        chosen = [found.kind] if found.kind else kinds
        tables = {kind: lists[kind]() for kind in chosen}
        print(as_json(tables[found.kind] if found.kind else tables))
    elif found.kind is None:
        print(_everything(lists))
    else:
        print(_full(found.kind, lists[found.kind](), found.runs))
    return 0


def algorithms() -> list[Row]:
    """Algorithms and what each is, with the ensemble form of each."""
    from pacesetter.algorithms import TABLE, multi_names, plugins

    rows = {name: entry.help for name, entry in TABLE.items()} | plugins()
    several = multi_names().items()
    rows |= {multi: f"{name} with --members 2 --rule best" for multi, name in several}
    return [{"name": name, "help": about} for name, about in rows.items()]


def envs() -> list[Row]:
    """Gymnasium's walkers by id."""
    from pacesetter.envs import known

    walkers = ("HalfCheetah", "Walker2d", "Ant", "Humanoid", "Hopper", "Swimmer")
    found = [name for name in known() if name.split("-")[0] in walkers or "pacesetter/" in name]
    return [{"name": name} for name in found]


def rules() -> list[Row]:
    """Selection rules."""
    from pacesetter.ensemble.rules import RULES

    return [
        {"name": name, "help": (inspect.getdoc(rule) or "").split("\n")[0]}
        for name, rule in RULES.items()
    ]


def presets() -> list[Row]:
    """Presets and where their values come from."""
    from pacesetter.config import presets

    return [
        {"name": name, "help": table["help"], "source": table["source"]}
        for name, table in presets().items()
    ]


def suites() -> list[Row]:
    """Suites that come with the package: how many runs each has, and what it is for."""
    from pacesetter.study.bench.suite import count, load, shipped

    found = [load(name) for name in shipped()]
    return [
        {"name": suite.name, "runs": f"{count(suite)} runs", "help": suite.help} for suite in found
    ]


def champions() -> list[Row]:
    """Policies that come with the package."""
    from pacesetter.policy import CHAMPION, champions, load

    found = [(name, load(file).about) for name, file in champions().items()]
    return [
        {"name": f"{CHAMPION}{name}", "env": about["env"], "step": about["step"]}
        for name, about in found
    ]


LISTS: dict[str, Callable[[], list[Row]]] = {
    "algorithms": algorithms,
    "envs": envs,
    "rules": rules,
    "presets": presets,
    "suites": suites,
    "champions": champions,
}
HINTS = {
    "envs": (
        "any other Gymnasium id with observations of numbers (no images) and bounded float "
        "actions, or module:Id-v0"
    )
}


def runs(folder: str) -> list[Row]:
    """Runs below a folder: how far each is and how its policy scores."""
    rows: list[Row] = []
    for run in find_all(folder):
        row: Row = {"name": str(run.path)}
        try:
            means = [each["mean"] for each in evaluations(run)]
            whole = row | state(run) | {"return": means[-1] if means else None}
            _run_cells(whole)  # one odd value must not end the list
            rows.append(whole)
        except (UsageError, *FAULTS) as error:
            rows.append(row | {"state": f"damaged or foreign: {error}"})
    return rows


def _everything(lists: dict[str, Callable[[], list[Row]]]) -> str:
    """The names of every kind, a paragraph each."""
    paragraphs = [
        fill(
            ", ".join(printable(row["name"]) for row in make()) or "none yet",
            WIDTH,
            initial_indent=f"{kind:12}",
            subsequent_indent=" " * 12,
            break_on_hyphens=False,
            break_long_words=False,
        )
        for kind, make in lists.items()
    ]
    return "\n".join([*paragraphs, "", "`pacesetter list KIND` tells more about each."])


def _full(kind: str, rows: list[Row], folder: str) -> str:
    if kind == "runs":
        if not rows:
            return f"no runs below {folder}"
        cells = [_run_cells(row) for row in rows]
        return _table(cells, ("run", "steps", "state", "return"))
    lines = _table([[_words(value) for value in row.values()] for row in rows])
    return "\n".join([lines, HINTS[kind]] if kind in HINTS else [lines])


def _run_cells(row: Row) -> list[str]:
    mean = row.get("return")
    steps = f"{row['step']:,} of {row['budget']:,}" if "step" in row else "-"
    return [row["name"], steps, row["state"], "-" if mean is None else f"{mean:.1f}"]


def _words(value: Any) -> str:
    return f"step {value:,}" if isinstance(value, int) else str(value)


def _table(rows: list[list[str]], headers: tuple[str, ...] = ()) -> str:
    rows = [[printable(cell) for cell in row] for row in rows]
    return tabulate(rows, headers=headers, tablefmt="plain", disable_numparse=True)
