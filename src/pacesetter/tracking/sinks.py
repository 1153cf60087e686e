"""The trackers. Each is one function: it opens the tool for a run and gives what takes its rows."""

import json
import logging
import os
import time
from collections.abc import Callable, Generator
from contextlib import AbstractContextManager, contextmanager, redirect_stdout
from pathlib import Path
from typing import Any, NamedTuple

from pacesetter.errors import UsageError
from pacesetter.extras import need
from pacesetter.runs import Row
from pacesetter.tracking.numbers import numbers

PROJECT = "pacesetter"
FLUSH_EVERY = 10  # seconds
KINDS = ("eval", "train", "select")

Write = Callable[[Row], None]


class Tracked(NamedTuple):
    """A run as a tracker sees it; `rows` are those that its log holds already."""

    folder: Path
    id: str
    title: str
    group: str
    settings: dict[str, Any]
    rows: list[Row]
    is_new: bool  # whether the tool has had none of it


class Sink(NamedTuple):
    """A tracker: what opens it, and the package that it needs."""

    open: Callable[[Tracked], AbstractContextManager[Write]]
    package: str


@contextmanager
def tensorboard(run: Tracked) -> Generator[Write]:
    """Event files in the run's folder, made anew from its log: so none holds a row twice."""
    writers = need("log", "tensorboardX", "pacesetter[tensorboard]")
    folder = run.folder / "tensorboard"
    if folder.is_symlink():
        raise UsageError(f"log: {folder} is a link, and what it leads to is not ours; remove it")
    for old in folder.glob("events.out.tfevents.*"):
        old.unlink()
    spent = run.rows[-1]["wall_seconds"] if run.rows else 0.0
    began = time.time() - spent
    # A TensorBoard that is open drops what it had read of the files before.
    with writers.SummaryWriter(str(folder), purge_step=0, flush_secs=FLUSH_EVERY) as writer:
        settings = json.dumps(run.settings, indent=1)
        writer.add_text("settings", f"```\n{settings}\n```", walltime=began)

        def write(row: Row) -> None:
            for name, value in numbers(row).items():
                writer.add_scalar(name, value, row["step"], began + row["wall_seconds"])

        for row in run.rows:
            write(row)
        yield write


@contextmanager
def wandb(run: Tracked) -> Generator[Write]:
    """A W&B run in the run's folder, offline unless WANDB_MODE says otherwise.

    A resumed run keeps its id. The server leaves out steps that it has, so all rows of a step go
    together, once a later one comes or the step has its evaluation.
    """
    mode = os.environ.get("WANDB_MODE", "offline")
    if mode == "offline":
        os.environ.setdefault("WANDB_ERROR_REPORTING", "false")
    tool = need("log", "wandb", "pacesetter[wandb]")
    opened = tool.init(
        project=os.environ.get("WANDB_PROJECT", PROJECT),
        id=run.id,
        name=run.title,
        group=run.group,
        config=run.settings,
        allow_val_change=True,
        resume="allow",
        mode=mode,
        dir=str(run.folder),
        settings=tool.Settings(silent=True, console="off"),
    )

    held: list[Row] = []

    def send() -> None:
        for row in held:
            opened.log(numbers(row), step=row["step"])
        held.clear()

    def write(row: Row) -> None:
        if held and row["step"] != held[0]["step"]:
            send()
        held.append(row)

    try:
        for row in run.rows:
            write(row)
        yield write
        if any(row["kind"] == "eval" for row in held):  # a stopped run may evaluate there later
            send()
    finally:
        opened.finish()


@contextmanager
def trackio(run: Tracked) -> Generator[Write]:
    """A trackio run, in a database of this machine (TRACKIO_DIR) that all runs share."""
    tool = need("log", "trackio", "pacesetter[trackio]")
    database = need("log", "trackio.sqlite_storage", "pacesetter[trackio]").SQLiteStorage
    name = f"{run.title} {run.id}"
    held = database.get_logs(PROJECT, name)
    last = {kind: _last([row["step"] for row in held if _mark(kind) in row]) for kind in KINDS}
    with _silent():
        opened = tool.init(
            project=PROJECT,
            name=name,
            group=run.group,
            config=run.settings,
            resume="allow",
            embed=False,
            auto_log_gpu=False,
            auto_log_cpu=False,
        )

    def write(row: Row) -> None:
        if row["step"] > last[row["kind"]]:
            opened.log(numbers(row), step=row["step"])

    try:
        for row in run.rows:
            write(row)
        yield write
    finally:
        with _silent():
            tool.finish()  # of the run itself would leave a second end to the exit


@contextmanager
def mlflow(run: Tracked) -> Generator[Write]:
    """An MLflow run, where MLFLOW_TRACKING_URI says: by default the file mlflow.db."""
    os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
    tool = need("log", "mlflow", "pacesetter[mlflow]")
    for name in ("mlflow", "alembic"):
        logging.getLogger(name).setLevel(logging.WARNING)
    client = tool.MlflowClient()
    number = _mlflow_run(client, run)
    if run.is_new:
        settings = [tool.entities.Param(key, str(each)) for key, each in run.settings.items()]
        client.log_batch(number, params=settings)
    held = {kind: client.get_metric_history(number, _mark(kind)) for kind in KINDS}
    last = {kind: _last([point.step for point in held[kind]]) for kind in KINDS}

    def write(row: Row) -> None:
        if row["step"] > last[row["kind"]]:
            now, step = int(time.time() * 1000), row["step"]
            found = numbers(row).items()
            client.log_batch(number, [tool.entities.Metric(*each, now, step) for each in found])

    client.update_run(number, status="RUNNING")
    try:
        for row in run.rows:
            write(row)
        yield write
    finally:
        client.set_terminated(number)


def _mlflow_run(client: Any, run: Tracked) -> str:
    """The id of the MLflow run that carries this run's id, made if there is none."""
    name = os.environ.get("MLFLOW_EXPERIMENT_NAME", PROJECT)
    experiment = client.get_experiment_by_name(name)
    place = experiment.experiment_id if experiment else client.create_experiment(name)
    found = client.search_runs([place], f"tags.`pacesetter.id` = '{run.id}'")
    if found:
        return found[0].info.run_id
    tags = {"pacesetter.id": run.id, "group": run.group}
    return client.create_run(place, tags=tags, run_name=run.title).info.run_id


def _mark(kind: str) -> str:
    """A number that every row of a kind has."""
    return f"{kind}/updates"


def _last(steps: list[int]) -> int:
    return max(steps, default=-1)


@contextmanager
def _silent() -> Generator[None]:
    """The standard output is for the command's answer."""
    with Path(os.devnull).open("w", encoding="utf-8") as nowhere, redirect_stdout(nowhere):
        yield


SINKS: dict[str, Sink] = {
    "tensorboard": Sink(tensorboard, "tensorboardX"),
    "wandb": Sink(wandb, "wandb"),
    "trackio": Sink(trackio, "trackio"),
    "mlflow": Sink(mlflow, "mlflow"),
}
