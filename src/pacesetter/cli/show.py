"""The verb `show`: where a run stands, what it scored and spent, its settings and versions; or
what a policy file says of itself."""

from pathlib import Path
from typing import Any

from tabulate import tabulate

from pacesetter.cli.flags import parser
from pacesetter.cli.policies import RUN
from pacesetter.errors import UsageError
from pacesetter.runs import Row, RunDirectory, find
from pacesetter.settings.budget import budget, is_spent, standing
from pacesetter.storage import FAULTS, as_json
from pacesetter.text import printable

SHOWN = 5  # evaluations, unless all are asked for
COUNTS = ("member_steps", "selection_steps", "updates", "transitions", "episodes")
TIMES = ("cpu_seconds", "wall_seconds")
MADE = ("command", "commit", "threads", "machine")


def show(words: list[str]) -> int:
    """Show a run: how far it is, how it scores, what it spent, its settings."""
    command = parser(
        "show", "Show a run: how far it is, how it scores, what it spent; or a policy file."
    )
    command.add_argument("run", metavar="RUN|FILE", help=RUN)
    about = f"show every evaluation (default the last {SHOWN})"
    command.add_argument("--all", action="store_true", help=about)
    command.add_argument("--json", action="store_true", help="print everything as a JSON object")
    command.add_runs()
    found = command.parse(words)
    from pacesetter.policy import file_of

    if file := file_of(found.run):
        told = tell_policy(file)
        print(as_json(told) if found.json else _policy_text(told))
        return 0
    run = find(found.run, found.runs)
    try:
        told = tell(run)
        text = as_json(told) if found.json else _text(told, None if found.all else SHOWN)
    except FAULTS as error:
        raise UsageError(f"{run.path}: damaged or foreign: {error}") from None
    print(text)
    return 0


def tell(run: RunDirectory) -> Row:
    """All that is told of a run, as plain values."""
    record, rows = run.record(), run.rows()
    last = rows[-1] if rows else {}
    spent = {key: last[key] for key in COUNTS if key in last}
    spent["selections"] = sum(row["kind"] == "select" for row in rows)
    spent |= {key: last[key] for key in TIMES if key in last}
    made = {key: record.get(key) for key in MADE}
    return {
        "name": str(run.path),
        **state(run),
        "evaluations": evaluations(run),
        "ledger": spent,
        "settings": record["settings"],
        "made": made | {"products": record.get("products") or "xla"},
        "versions": record.get("versions", {}),
    }


def tell_policy(file: Path) -> Row:
    """All that a policy file says of itself, as plain values."""
    from pacesetter.policy import load

    policy = load(file)
    return {
        "name": str(file),
        "actors": len(policy.actors),
        "sizes": policy.sizes,
        "normalizes": policy.normalizer is not None,
        "low": [float(x) for x in policy.low],
        "high": [float(x) for x in policy.high],
        "about": policy.about,
    }


def state(run: RunDirectory) -> Row:
    """How far a run is, and whether it is running, finished or stopped."""
    settings, rows = run.settings(), run.rows()
    last = rows[-1] if rows else {"step": 0, "wall_seconds": 0.0}
    evaluated = [row for row in rows if row["kind"] == "eval"]
    now = standing((row["step"], row["mean"], row["updates"]) for row in evaluated)
    over = is_spent(settings, last["step"], last["wall_seconds"], now)
    name = "running" if run.in_use() else "finished" if over else "stopped"
    return {"step": last["step"], "budget": budget(settings), "state": name}


def evaluations(run: RunDirectory) -> list[Row]:
    """Step, mean, standard deviation and episodes of each evaluation."""
    return [
        {key: row[key] for key in ("step", "mean", "std")} | {"episodes": len(row["returns"])}
        for row in run.rows("eval")
    ]


def _text(told: Row, most: int | None) -> str:
    every = told["evaluations"]
    recent = every[-most:] if most else every
    scores = [
        (f"{row['step']:,}", f"{row['mean']:.1f}", f"{row['std']:.1f}", row["episodes"])
        for row in recent
    ]
    left = len(every) - len(recent)
    hidden = f"{left} earlier evaluation{'s' if left > 1 else ''} left out; --all shows every one"
    spent = {key: f"{n:.0f}" if key in TIMES else n for key, n in told["ledger"].items()}
    parts = [
        f"{told['name']}: {told['step']:,} of {told['budget']:,} steps, {told['state']}",
        _table(scores, ("step", "return", "std", "episodes")) + (f"\n{hidden}" if left else ""),
        *(_table(list(table.items())) for table in (spent, told["settings"])),
        _table([*told["made"].items(), *told["versions"].items()]),
    ]
    return "\n\n".join(parts)


def _policy_text(told: Row) -> str:
    versions = told["about"].get("versions")
    apart = isinstance(versions, dict)  # a file may say anything
    about = {key: x for key, x in told["about"].items() if not (apart and key == "versions")}
    own = {key: told[key] for key in ("actors", "sizes", "normalizes", "low", "high")}
    tables = (list(table.items()) for table in (about, own, versions if apart else {}))
    return "\n\n".join([told["name"], *(_table(table) for table in tables if table)])


def _table(rows: list[Any], headers: tuple[str, ...] = ()) -> str:
    shown = [["-" if cell is None else printable(str(cell)) for cell in row] for row in rows]
    return tabulate(shown, headers=headers, tablefmt="plain", disable_numparse=True)
