"""What a run reports and when: evaluations, selections and training, each a row of its log."""

from typing import Any

from pacesetter.config import Config
from pacesetter.ensemble.loop import Loop
from pacesetter.ensemble.progress import TRAIN_ROW_EVERY, Clock
from pacesetter.runs import RunDirectory
from pacesetter.training.evaluator import Evaluator, Stopped
from pacesetter.training.report import Report


class Reporter:
    """Writes rows to the log, and holds their reports until the trainer gives them out."""

    def __init__(
        self, loop: Loop, config: Config, directory: RunDirectory, evaluator: Evaluator
    ) -> None:
        self.loop, self.config, self.directory = loop, config, directory
        self.evaluator = evaluator
        self._clock, self._waiting = Clock(), list[Report]()

    def start_clock(self) -> None:
        """Count time from now on."""
        self._clock = Clock()

    def tell_time(self) -> None:
        """Add the time since this was last called to the run's counters."""
        self._clock.tell(self.loop.progress)

    def due(self, ending: bool) -> list[Report]:
        """Make the rows that are due now; all reports since this was last called."""
        progress = self.loop.progress
        pending = ending and bool(progress.ended or progress.losses)
        if progress.step >= progress.next_train or pending:
            progress.next_train = (progress.step // TRAIN_ROW_EVERY + 1) * TRAIN_ROW_EVERY
            self.add("train", self.loop.training_values())
        last = ending and progress.last_evaluation < progress.step
        # The last one waits for all updates that the budget's last steps made due.
        if (progress.step >= progress.next_evaluation and progress.step < self.loop.budget) or last:
            self._evaluate(ending)
        reports, self._waiting = self._waiting, []
        return reports

    def add(self, kind: str, values: dict[str, Any]) -> None:
        """Write one row."""
        self.tell_time()
        report = Report(kind, self.loop.progress.step, values, self.ledger())
        self.directory.log.append(report.row())
        self._waiting.append(report)

    def ledger(self) -> dict[str, Any]:
        """What the run has spent."""
        progress = self.loop.progress
        return progress.ledger() | self.loop.learners.ledger(progress.updates, progress.actions)

    def _evaluate(self, ending: bool) -> None:
        progress = self.loop.progress
        try:
            values = self.evaluator.evaluate(ending)
        except Stopped:
            return
        self.add("eval", values)
        every = self.config.run.eval_every * self.config.steps_per_count
        progress.last_evaluation = progress.step
        progress.next_evaluation = (progress.step // every + 1) * every
