"""What a trainer tells of a run, row by row."""

from dataclasses import dataclass
from typing import Any


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
