"""Runs in groups that differ by seed only: the data of every table, figure and page."""

import re
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from pacesetter.study.compare.results import Run
from pacesetter.study.compare.stats import Array

METRICS = {
    "final": "mean of the evaluations in the last 10% of the budget, and of at least three; of one "
    "or two, the last; none before the first update counts",
    "auc": "area under the curve of evaluations, divided by the env steps it spans",
    "max": "largest evaluation after the first update; inflated, as a maximum of noisy values is",
}
CONTROL = "td3"
ANT = "pacesetter/Ant111"
_SPENT = ("steps", "updates", "transitions", "cpu", "wall")


@dataclass(frozen=True)
class Group:
    """Runs of one algorithm on one task that differ by seed."""

    env: str
    name: str
    runs: list[Run]

    def values(self, metric: str) -> Array:
        return np.array([run.metric(metric) for run in self.runs])

    def reached(self, level: float) -> Array:
        return np.array([run.reached(level) for run in self.runs])

    @cached_property
    def spent(self) -> dict[str, float]:
        """Ledger of a mean run; what only some algorithms count comes after what all do."""
        table = {key: np.mean([getattr(run, key)[-1] for run in self.runs]) for key in _SPENT}
        for key in sorted({key for run in self.runs for key in run.extra}):
            spent = [run.extra[key][-1] if key in run.extra else 0 for run in self.runs]
            table[key] = np.mean(spent)
        return {key: float(value) for key, value in table.items()}

    @property
    def budgets(self) -> list[int]:
        return sorted({run.budget for run in self.runs})

    @property
    def evaluations(self) -> int:
        """Evaluations that count for the final return of the run that has the fewest."""
        return min(int(run.counted.sum()) for run in self.runs)

    def cut(self, budget: int) -> "Group":
        return Group(self.env, self.name, [run.cut(budget) for run in self.runs])


@dataclass(frozen=True)
class Comparison:
    """The groups, the metric, the control, and what a reader must be told.

    `damaged` says why each run that could not be read is left out.
    """

    groups: list[Group]
    metric: str
    reference: str
    notes: list[str]
    damaged: list[str] = field(default_factory=list[str])

    @property
    def envs(self) -> list[str]:
        return list(dict.fromkeys(group.env for group in self.groups))

    @property
    def names(self) -> list[str]:
        """Algorithms, the control first."""
        names = sorted({group.name for group in self.groups})
        return sorted(names, key=lambda name: name != self.reference)

    @property
    def runs(self) -> list[Run]:
        return [run for group in self.groups for run in group.runs]

    @property
    def budget(self) -> int | None:
        """Env steps of every run, None if they are mixed."""
        budgets = {run.budget for run in self.runs}
        return budgets.pop() if len(budgets) == 1 else None

    @property
    def seeds(self) -> int:
        """Runs of the group that has the fewest."""
        return min(len(group.runs) for group in self.groups)

    def __repr__(self) -> str:
        from pacesetter.study.report.contents import title

        count = f"{len(self.runs)} run{'s' if len(self.runs) > 1 else ''}"
        return f"Comparison({title(self)}: {count}, {self.metric})"

    def _repr_html_(self) -> str:
        """The table of the metric, for notebooks."""
        from pacesetter.study.report.output import notebook

        return notebook(self)

    def on(self, env: str) -> list[Group]:
        """The groups of a task, the control first."""
        return [group for name in self.names if (group := self.find(env, name))]

    def find(self, env: str, name: str) -> Group | None:
        return next((g for g in self.groups if (g.env, g.name) == (env, name)), None)

    def control(self, group: Group) -> Group | None:
        """The control on a group's task; None where there is none, and for the control itself."""
        found = self.find(group.env, self.reference)
        return None if found is group else found


def split(env: str) -> tuple[str, str]:
    """A task without its version, and the version; the Ant with 111 observations is an Ant."""
    if env.startswith(ANT):
        task, version = split(env.replace(ANT, "Ant", 1))
        return task, f"{version}, 111"
    name, space, keywords = env.partition(" ")
    found = re.fullmatch(r"(.*)-(v\d+)(.*)", name)
    return (found[1] + found[3] + space + keywords, found[2]) if found else (env, "-")
