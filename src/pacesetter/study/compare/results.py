"""Results of one run, read from its folder or from a line of results/*.jsonl."""

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field

from pacesetter.errors import UsageError
from pacesetter.runs import OLDER, Row, RunDirectory
from pacesetter.runs.records import check_record
from pacesetter.settings.budget import budget, is_spent, standing, steps_per_count
from pacesetter.settings.validation import Finite, Natural, check
from pacesetter.study.compare import stats
from pacesetter.study.compare.stats import Array
from pacesetter.text import printable

COLUMNS = ("step", "returns", "updates", "transitions", "cpu_seconds", "wall_seconds")
AXES = {
    "steps": "env steps, all members",
    "updates": "gradient updates",
    "cpu": "CPU seconds",
    "wall": "wall-clock seconds",
}
PROVENANCE = ("command", "versions", "commit", "threads", "machine")
SELECTION = ("step", "gap", "standard_error", "parents", "champion")
LARGEST = 1e60  # of a number in them, so that no square is infinite
DECIMALS = 3  # of a return in a line of results
# Numbers in an evaluation's row that are not spent; the others are counts of an algorithm.
_NOT_SPENT = {"mean", "std", "champion", "episodes", *COLUMNS}


_Spent = Annotated[Finite, Field(ge=-LARGEST, le=LARGEST)]


class _Line(BaseModel):
    """A line of results, beside what a config.json holds."""

    columns: list[str]
    evaluations: list[list[_Spent | Annotated[list[_Spent], Field(min_length=1)]]]
    selections: list[tuple[Natural, Finite | None, Finite | None, list[Natural], Natural]] = Field(
        []
    )
    varied: list[dict[str, list[Finite]]] = Field([])


@dataclass(frozen=True)
class Run:
    """Evaluations of a run: arrays (N,), cut at a budget; `returns` are means over episodes.

    `extra` is what only some algorithms count, such as steps in a model.
    """

    source: str
    table: Row
    steps: Array
    returns: Array
    updates: Array
    transitions: Array
    cpu: Array
    wall: Array
    extra: dict[str, Array]
    folder: Path | None = None

    @cached_property
    def settings(self) -> Row:
        return OLDER | self.table["settings"]

    @property
    def env(self) -> str:
        """The task: env id with version, and keywords and wrappers if there are any."""
        kwargs, wrap = self.settings.get("env_kwargs") or {}, self.settings.get("wrap") or ()
        words = [f"{k}={v}" for k, v in sorted(kwargs.items())]
        words += [f"wrap={name}" for name in wrap]
        return printable(" ".join([self.settings["env"], *words]))

    @property
    def name(self) -> str:
        return self.settings["name"]

    @property
    def seed(self) -> int:
        return self.settings["seed"]

    @cached_property
    def clock(self) -> Array:
        """Steps at which the evaluations were due (N,); they come at the next tick's end."""
        every = self.settings["eval_every"] * steps_per_count(self.settings)
        due = self.steps // every * every
        again = np.diff(due, prepend=-1) == 0  # the one at the end of an odd budget
        ended = self.steps >= self.planned
        return np.where(ended, self.planned, np.where(again, self.steps, due))

    @property
    def planned(self) -> int:
        """Env steps the run was to make."""
        return budget(self.settings)

    @property
    def budget(self) -> int:
        """Env steps up to which the run counts, by its plan or its time limit."""
        return min(self.planned, int(self.clock[-1]))

    @property
    def finished(self) -> bool:
        now = standing(zip(self.steps, self.returns, self.updates, strict=True))
        return is_spent(self.settings, self.clock[-1], self.wall[-1], now)

    def cut(self, budget: int) -> "Run":
        """The run as it was at a budget."""
        kept = self.clock <= budget
        names = ("steps", "returns", "updates", "transitions", "cpu", "wall")
        cut: dict[str, Any] = {name: getattr(self, name)[kept] for name in names}
        cut["extra"] = {name: values[kept] for name, values in self.extra.items()}
        steps = min(budget, self.planned) // steps_per_count(self.settings)
        settings = self.settings | {"steps": steps}
        return replace(self, **cut, table=self.table | {"settings": settings})

    def within(self, cpu: float) -> "Run":
        """The run as it was when it had spent so many CPU seconds."""
        return self.cut(int(self.clock[self.cpu <= cpu].max(initial=-1)))

    def metric(self, name: str) -> float:
        """`final`, `auc` or `max`; the first and last are of evaluations after the first update.

        A run without any has the final return of the policy that it began with.
        """
        if name == "auc":
            return stats.area(self.steps, self.returns)
        if name == "final":
            return stats.final(self.clock[self.counted], self.returns[self.counted], self.budget)
        learned = self.returns[self.updates > 0]
        return float(learned.max()) if learned.size else np.nan

    @property
    def has_learned(self) -> bool:
        """Whether an evaluation is of a policy that has been updated."""
        return bool((self.updates > 0).any())

    @property
    def counted(self) -> NDArray[np.bool_]:
        """Which evaluations (N,) count for the final return."""
        learned = self.updates > 0
        return learned if self.has_learned else np.ones_like(learned)

    @property
    def makers(self) -> list[Row]:
        """What made the run: where it began, and each session that resumed it."""
        return [self.table, *(self.table | row for row in self.table.get("resumed", []))]

    def reached(self, level: float) -> float:
        """Env steps at which a policy that has learned at all first had a return of `level`."""
        learned = self.updates > 0
        return stats.reached(self.clock[learned], self.returns[learned], level)

    @property
    def selections(self) -> list[Any]:
        """A row of SELECTION for each selection up to the cut."""
        return [row for row in self.table.get("selections", []) if row[0] <= self.steps[-1]]

    @property
    def varied(self) -> list[Any]:
        """Values of the settings that differ, by name (K,): at the start and after each selection
        up to the cut; empty where none differ."""
        return self.table.get("varied", [])[: len(self.selections) + 1]


def compact(run: RunDirectory) -> Row:
    """A run as one line: config, versions, commit, evaluations with their ledger, selections."""
    record, rows = run.record(), run.rows("eval", "select")
    evaluations = [row for row in rows if row["kind"] == "eval"]
    columns = [*COLUMNS, *_extra(evaluations)]
    try:
        return {
            **record,
            "columns": columns,
            "evaluations": [[_short(row[column]) for column in columns] for row in evaluations],
            "selections": [
                [row[column] for column in SELECTION] for row in rows if row["kind"] == "select"
            ],
            **_varied(rows),
        }
    except (KeyError, TypeError) as error:
        raise UsageError(f"{run.metrics_file}: damaged: {error} is missing in a row") from None


def _varied(rows: list[Row]) -> Row:
    """The members' settings at the start and after each selection, if they differ."""
    found = [row["settings"] for row in rows[:1] if "settings" in row]
    found += [row["settings"] for row in rows if row["kind"] == "select" and "settings" in row]
    return {"varied": found} if found else {}


def _extra(evaluations: list[Row]) -> list[str]:
    last = evaluations[-1] if evaluations else {}
    counts = {key for key, value in last.items() if isinstance(value, (int, float)) and value}
    return sorted(counts - _NOT_SPENT)


def _short(value: Any) -> Any:
    return [round(one, DECIMALS) for one in value] if isinstance(value, list) else value


def read(source: str, table: Any, folder: Path | None = None) -> Run | None:
    """Check one line of results; None if the run has no evaluation yet."""
    try:
        missing = [key for key in PROVENANCE if key not in table]
        if missing:
            raise ValueError(f"no {', '.join(missing)}; a result without them is not compared")
        check_record(table)
        check(_Line, table)
        names = table["columns"][len(COLUMNS) :]
        if table["columns"] != [*COLUMNS, *names]:
            raise ValueError(f"columns must begin with {', '.join(COLUMNS)}")
        if not table["evaluations"]:
            return None
        columns = list(zip(*table["evaluations"], strict=True))
        columns[1] = tuple(sum(returns) / len(returns) for returns in columns[1])
        arrays = [np.array(column, dtype=float) for column in columns]
        extra = dict(zip(names, arrays[len(COLUMNS) :], strict=True))
        run = Run(source, table, *arrays[: len(COLUMNS)], extra=extra, folder=folder)
        if (np.diff(run.steps, prepend=0) < 0).any():
            raise ValueError("evaluations: their steps must never fall")
        members = run.settings.get("members", 1)
        rows: list[Any] = table.get("selections", [])
        if any(len(row[3]) != members or max(*row[3], row[4]) >= members for row in rows):
            raise ValueError(f"selections: parents and champion must be of {members} members")
        varied: list[Any] = table.get("varied", [])
        if varied and len(varied) != len(rows) + 1:
            raise ValueError("varied: must have a row at the start and one per selection")
        if any(row.keys() != varied[0].keys() for row in varied):
            raise ValueError("varied: must name the same settings in each row")
        if any(len(each) != members for row in varied for each in row.values()):
            raise ValueError(f"varied: must have {members} values of each setting")
    except (ValueError, TypeError, LookupError) as error:
        raise UsageError(f"{source}: damaged or foreign: {error}") from None
    return run
