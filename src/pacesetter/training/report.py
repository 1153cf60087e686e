"""What a trainer tells of a run, row by row."""

from dataclasses import dataclass
from typing import Any

SHOWN = 4  # values in a repr


@dataclass(frozen=True)
class Report:
    """One row of the log: an evaluation, a selection, or how training went since the last row."""

    kind: str
    step: int
    values: dict[str, Any]
    ledger: dict[str, Any]

    def row(self) -> dict[str, Any]:
        """As the line of metrics.jsonl."""
        return {"kind": self.kind, "step": self.step, **self.values, **self.ledger}

    def __repr__(self) -> str:
        numbers = {k: v for k, v in self.values.items() if isinstance(v, (int, float))}
        shown = ", ".join(f"{key} {value:.5g}" for key, value in [*numbers.items()][:SHOWN])
        return f"Report({self.kind} at step {self.step:,}{': ' if shown else ''}{shown})"
