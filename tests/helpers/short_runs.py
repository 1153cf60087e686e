"""Short runs, their logs without clocks, and the exact content of a run."""

from typing import Any

from pacesetter import storage
from pacesetter.runs import RunDirectory
from pacesetter.training.trainer import Trainer

CLOCKS = ("cpu_seconds", "wall_seconds")
TINY: dict[str, Any] = {
    "hidden": (16, 16),
    "batch_size": 16,
    "warmup": 100,
    "replay_size": 10_000,
    "eval_every": 1_000,
    "eval_episodes": 1,
    "checkpoint_every": 3600,
}


def log(directory: RunDirectory) -> list[dict[str, Any]]:
    """Rows of the log without clock fields."""
    return [{k: v for k, v in row.items() if k not in CLOCKS} for row in directory.rows()]


def content(directory: RunDirectory) -> dict[str, Any]:
    """All that a finished run holds but settings and clocks: arrays, counters, streams, log."""
    arrays, table = storage.read(directory.state_file, "checkpoint")
    table["progress"] = {k: v for k, v in table["progress"].items() if k not in CLOCKS}
    del table["log"], table["log_hash"], table["settings"]
    return {"arrays": arrays, "table": table, "log": log(directory)}


def assert_same(one: RunDirectory, other: RunDirectory) -> None:
    """Two runs are equal bit for bit; the replay is compared through its hashes in the table."""
    a, b = content(one), content(other)
    assert a["arrays"].keys() == b["arrays"].keys()
    for name, array in a["arrays"].items():
        assert array.tobytes() == b["arrays"][name].tobytes(), name
    assert a["table"] == b["table"]
    assert a["log"] == b["log"]


def run_to_end(trainer: Trainer) -> RunDirectory:
    """Train until the budget is spent."""
    for _ in trainer:
        pass
    return trainer.directory


def run_to_step(trainer: Trainer, step: int) -> RunDirectory:
    """Train until so many steps are made, then end as a signal would."""
    tick = trainer.loop.tick

    def tick_and_stop() -> Any:
        selection = tick()
        if trainer.progress.step >= step:
            trainer.stop()
        return selection

    trainer.loop.tick = tick_and_stop
    run_to_end(trainer)
    assert trainer.progress.step == step
    return trainer.directory
