"""The verbs `list` and `show`: what there is, as lines."""

import inspect
from typing import Any

from tabulate import tabulate

from pacesetter.cli.flags import parser
from pacesetter.errors import UsageError, unknown
from pacesetter.runs import Row, RunDirectory, find, find_all
from pacesetter.settings.budget import budget, is_spent

SHOWN_EVALUATIONS = 5


def list_(words: list[str]) -> int:
    """List algorithms, envs, rules, presets, suites or runs."""
    command = parser("list", "List algorithms, envs, rules, presets, suites or runs.")
    nouns = [*LISTS, "runs"]
    command.add_argument("noun", metavar="|".join(nouns), help="what to list")
    command.add_runs()
    found = command.parse(words)
    if found.noun not in nouns:
        raise unknown("list", found.noun, nouns)
    for line in runs(found.runs) if found.noun == "runs" else LISTS[found.noun]():
        print(line)
    return 0


def show(words: list[str]) -> int:
    """Show a run: how far it is, how it scores, what it spent, its settings."""
    command = parser("show", "Show a run: how far it is, how it scores, what it spent.")
    command.add_argument("run", metavar="RUN", help="run folder, or the end of its path")
    command.add_runs()
    found = command.parse(words)
    for line in describe(find(found.run, found.runs)):
        print(line)
    return 0


def algorithms() -> list[str]:
    """Algorithms and what each is, with the ensemble form of each."""
    from pacesetter.algorithms import TABLE, names, plugins, single_member

    rows = [(name, entry.help) for name, entry in TABLE.items()]
    rows += [(name, target) for name, target in plugins().items()]
    several = [name for name in names() if not single_member(name)]
    rows += [(f"multi-{name}", f"{name} with --members 2 --rule best") for name in several]
    return _table(rows)


def envs() -> list[str]:
    """Gymnasium's walkers by id, and what else `train` takes."""
    from pacesetter.envs import known

    walkers = ("HalfCheetah", "Walker2d", "Ant", "Humanoid", "Hopper", "Swimmer")
    found = [name for name in known() if name.split("-")[0] in walkers or "pacesetter/" in name]
    return [*found, "any other Gymnasium id with Box observations and actions, or module:Id-v0"]


def rules() -> list[str]:
    """Selection rules."""
    from pacesetter.ensemble.rules import RULES

    return _table(
        [(name, (inspect.getdoc(rule) or "").split("\n")[0]) for name, rule in RULES.items()]
    )


def presets() -> list[str]:
    """Presets and where their values come from."""
    from pacesetter.config import presets

    return _table([(name, table["help"], table["source"]) for name, table in presets().items()])


def suites() -> list[str]:
    """Suites that come with the package: how many runs each has, and what it is for."""
    from pacesetter.study.bench.suite import count, load, shipped

    found = [load(name) for name in shipped()]
    return _table([(suite.name, f"{count(suite)} runs", suite.help) for suite in found])


def champions() -> list[str]:
    """Policies that come with the package."""
    from pacesetter.cli.policies import CHAMPION, champions
    from pacesetter.policy import load

    found = [(name, load(file).about) for name, file in champions().items()]
    return _table(
        [(f"{CHAMPION}{name}", about["env"], f"step {about['step']:,}") for name, about in found]
    )


LISTS = {
    "algorithms": algorithms,
    "envs": envs,
    "rules": rules,
    "presets": presets,
    "suites": suites,
    "champions": champions,
}


def runs(folder: str) -> list[str]:
    """Runs below a folder: how far each is and how its champion scores."""
    rows: list[tuple[Any, ...]] = []
    for run in find_all(folder):
        try:
            rows.append((run.path, *_state(run)))
        except (UsageError, KeyError, TypeError) as error:
            rows.append((run.path, "-", f"damaged or foreign: {error}", "-"))
    if not rows:
        return [f"no runs below {folder}"]
    return _table(rows, ("run", "steps", "state", "return"))


def describe(run: RunDirectory) -> list[str]:
    """One run: where it stands, its last evaluations, what it spent, its settings and versions."""
    try:
        return _describe(run)
    except (KeyError, TypeError) as error:
        raise UsageError(f"{run.path}: damaged or foreign: {error}") from None


def _describe(run: RunDirectory) -> list[str]:
    record, rows = run.record(), run.rows()
    steps, state, _ = _state(run)
    evaluations = [row for row in rows if row["kind"] == "eval"]
    recent = [
        (f"{row['step']:,}", f"{row['mean']:.1f}", f"{row['std']:.1f}", len(row["returns"]))
        for row in evaluations[-SHOWN_EVALUATIONS:]
    ]
    made = [(key, record[key]) for key in ("command", "commit", "threads", "machine")]
    made.append(("products", record.get("products") or "xla"))
    return [
        f"{run.path}: {steps} steps, {state}",
        "",
        *_table(recent, ("step", "return", "std", "episodes")),
        "",
        *_table(_ledger(rows)),
        "",
        *_table(list(record["settings"].items())),
        "",
        *_table([*made, *record["versions"].items()]),
    ]


def _ledger(rows: list[Row]) -> list[tuple[str, Any]]:
    """What a run has spent, by the last row of its log."""
    last = rows[-1] if rows else {}
    counts = ("member_steps", "selection_steps", "updates", "transitions", "episodes")
    times = ("cpu_seconds", "wall_seconds")
    return [
        *((key, last[key]) for key in counts if key in last),
        ("selections", sum(row["kind"] == "select" for row in rows)),
        *((key, f"{last[key]:.0f}") for key in times if key in last),
    ]


def _state(run: RunDirectory) -> tuple[str, str, str]:
    """How far a run is, its state, and its last evaluation."""
    settings, rows = run.settings(), run.rows()
    last = rows[-1] if rows else {"step": 0, "wall_seconds": 0.0}
    over = is_spent(settings, last["step"], last["wall_seconds"])
    state = "running" if run.in_use() else "finished" if over else "stopped"
    means = [row["mean"] for row in rows if row["kind"] == "eval"]
    steps = f"{last['step']:,} of {budget(settings):,}"
    return steps, state, f"{means[-1]:.1f}" if means else "-"


def _table(rows: list[Any], headers: tuple[str, ...] = ()) -> list[str]:
    text = tabulate(rows, headers=headers, tablefmt="plain", disable_numparse=True)
    return text.split("\n") if text else []
