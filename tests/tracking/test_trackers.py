"""`--log`: each tracker holds what the log holds, whatever happened to the run in between."""

import json
import math
from collections import Counter
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import tracker_files
from short_runs import CLOCKS, TINY

from pacesetter.cli.main import main
from pacesetter.runs import Row, RunDirectory
from pacesetter.tracking import SINKS, numbers, tracked
from pacesetter.tracking.sinks import Sink, Tracked
from pacesetter.training.trainer import Trainer

TASK = "probe_envs:Scripted-v0"
SETTINGS: dict[str, Any] = TINY | {"members": 2, "steps": 400, "eval_every": 100, "warmup": 50}
WORDS = ["--hidden", "8", "--batch-size", "8", "--warmup", "50", "--steps", "200", "-q"]
WORDS += ["--eval-every", "100", "--eval-episodes", "1", "--replay-size", "1k"]
Points = dict[tuple[str, int], float]


def test_names_are_those_of_the_log() -> None:
    """A list has its places, a table its keys, and events the mean of each column."""
    evaluation = {"kind": "eval", "step": 7, "mean": 1.5, "returns": [1, 2.0], "terms": {"a": 3}}
    assert numbers(evaluation) == {
        "eval/mean": 1.5,
        "eval/returns/0": 1.0,
        "eval/returns/1": 2.0,
        "eval/terms/a": 3.0,
    }
    episodes = [[0, 10.0, 4], [1, 30.0, 8]]
    row = {"kind": "train", "step": 7, "episodes_ended": episodes, "assessed": [[0, True]]}
    assert numbers(row) == {
        "train/episodes_ended/return": 20.0,
        "train/episodes_ended/length": 6.0,
        "train/assessed/kept": 1.0,
    }
    nothing = {"kind": "train", "step": 7, "episodes_ended": [], "critic_loss": None, "x": [None]}
    assert numbers(nothing) == {}
    selection = {"kind": "select", "step": 7, "returns": [[1.0, 3.0], [5.0]], "parents": [1, 1]}
    assert numbers(selection) == {
        "select/returns/0": 2.0,
        "select/returns/1": 5.0,
        "select/parents/0": 1.0,
        "select/parents/1": 1.0,
    }


# A run that is killed between two checkpoints, and resumed.


@pytest.fixture
def places(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the tools write."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TRACKIO_DIR", str(tmp_path / "trackio"))
    monkeypatch.setenv("MLFLOW_TRACKING_URI", f"sqlite:///{tmp_path / 'mlflow.db'}")


@pytest.mark.parametrize("tool", SINKS)
@pytest.mark.filterwarnings("ignore")
def test_a_tracker_holds_the_log_once(tool: str, runs: Path, places: None) -> None:
    pytest.importorskip(SINKS[tool].package)
    last_kind = "eval" if tool == "wandb" else "select"  # W&B takes a step once, as a whole
    trainer = Trainer("multi-td3", TASK, runs=runs, **SETTINGS)
    with tracked(trainer.directory, [tool]) as write:
        for report in trainer:
            write(report.row())
            if report.step >= 100:
                trainer.save = lambda: None  # a kill: rows that no checkpoint covers
            if report.step >= 200 and report.kind == last_kind:
                break
    before = trainer.directory.rows()
    resumed = Trainer.resume(trainer.directory.path)
    assert len(resumed.directory.rows()) < len(before)
    with tracked(resumed.directory) as write:
        for report in resumed:
            write(report.row())
    points = getattr(tracker_files, tool)(resumed.directory)
    assert max(Counter(point[:2] for point in points).values()) == 1
    assert without_clocks(points) == pytest.approx(expected(resumed.directory))


def expected(directory: RunDirectory) -> Points:
    rows = directory.rows()
    assert {row["kind"] for row in rows} == {"eval", "train", "select"}
    return without_clocks(
        (name, row["step"], value) for row in rows for name, value in numbers(row).items()
    )


def without_clocks(points: Any) -> Points:
    return {(name, step): v for name, step, v in points if name.split("/")[1] not in CLOCKS}


# A tracker joins late, leaves, or fails.


def train(runs: Path, *words: str) -> int:
    return main(["train", "td3", TASK, *WORDS, "--runs", str(runs), *words])


def recorded(into: list[Row]) -> Callable[[Tracked], Any]:
    @contextmanager
    def open_(run: Tracked) -> Generator[Callable[[Row], None]]:
        into.extend(run.rows)
        yield into.append

    return open_


@pytest.fixture
def listening(monkeypatch: pytest.MonkeyPatch) -> list[Row]:
    """The rows that come to a tracker called `list`."""
    rows: list[Row] = []
    monkeypatch.setitem(SINKS, "list", Sink(recorded(rows), "json"))
    return rows


def test_resume_goes_on_with_the_same_trackers(runs: Path, listening: list[Row]) -> None:
    assert train(runs, "--log", "list") == 0
    path = runs / "probe_envs-Scripted-v0" / "td3" / "0"
    assert listening == RunDirectory(path).rows()
    listening.clear()
    assert main(["resume", str(path), "--steps", "300", "-q"]) == 0
    assert listening == RunDirectory(path).rows()
    assert listening[-1]["step"] == 300
    assert main(["resume", str(path), "--steps", "350", "--log", "none", "-q"]) == 0
    assert listening[-1]["step"] == 300
    assert main(["resume", str(path), "--steps", "400", "-q"]) == 0
    assert listening[-1]["step"] == 300


def test_a_tracker_that_joins_late_gets_all_rows(runs: Path, listening: list[Row]) -> None:
    assert train(runs) == 0
    path = runs / "probe_envs-Scripted-v0" / "td3" / "0"
    assert not (path / "trackers.json").exists()
    assert main(["resume", str(path), "--steps", "300", "--log", "list", "-q"]) == 0
    assert listening == RunDirectory(path).rows()
    assert {0, 100, 300} <= {row["step"] for row in listening}


def test_a_tracker_that_is_not_installed_stops_the_command_before_the_run(
    runs: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(SINKS, "wandb", SINKS["wandb"]._replace(package="no_such_package"))
    assert train(runs, "--log", "tensorboard,wandb") == 2
    line = "log: no_such_package is not installed; pip install 'pacesetter[wandb]'"
    assert capsys.readouterr().err == f"pacesetter: {line}\n"
    assert not runs.exists()
    bench = ["bench", "--algos", "td3", "--envs", TASK, "--runs", str(runs), "--log", "wandb"]
    assert main(bench) == 2
    assert capsys.readouterr().err == f"pacesetter: {line}\n"
    assert train(runs, "--log", "none,tensorboard") == 2
    assert "log: none stands alone or not at all" in capsys.readouterr().err
    assert train(runs, "--log", "tensorbord") == 2
    assert "unknown 'tensorbord'; did you mean tensorboard?" in capsys.readouterr().err


def test_a_tracker_that_fails_costs_no_step(
    runs: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    taken: list[Row] = []

    @contextmanager
    def weak(run: Tracked) -> Generator[Callable[[Row], None]]:
        def write(row: Row) -> None:
            taken.append(row)
            if len(taken) == 2:
                raise ConnectionError("the network is away")

        yield write
        raise OSError("and so it cannot be closed")

    monkeypatch.setitem(SINKS, "weak", Sink(weak, "json"))
    assert train(runs, "--log", "weak") == 0
    first, second = capsys.readouterr().err.splitlines()
    assert first == (
        "pacesetter: log: weak failed: ConnectionError: the network is away; goes on without it"
    )
    assert second == "pacesetter: log: weak failed: OSError: and so it cannot be closed"
    assert len(taken) == 2
    assert RunDirectory(runs / "probe_envs-Scripted-v0" / "td3" / "0").rows()[-1]["step"] == 200


def test_a_tracker_that_cannot_be_opened_stops_the_run(
    runs: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    @contextmanager
    def shut(run: Tracked) -> Generator[Callable[[Row], None]]:
        raise ConnectionError("no server\nat all")
        yield print

    monkeypatch.setitem(SINKS, "shut", Sink(shut, "json"))
    assert train(runs, "--log", "shut") == 1
    path = runs / "probe_envs-Scripted-v0" / "td3" / "0"
    assert capsys.readouterr().err == (
        "pacesetter: stopped: log: shut failed: ConnectionError: no server at all; "
        f"`pacesetter resume {path} --allow {TASK} --log none` goes on without it\n"
    )
    assert main(["resume", str(path), "--log", "none", "-q"]) == 0


FOREIGN = {"id": "../../../x", "trackers": ["list"], "known": []}


def test_a_damaged_record_is_one_line(
    runs: Path, capsys: pytest.CaptureFixture[str], listening: list[Row]
) -> None:
    assert train(runs) == 0
    path = runs / "probe_envs-Scripted-v0" / "td3" / "0"
    for text in ("{", "[]", json.dumps({"id": 1}), json.dumps(FOREIGN), "[" * 99_999):
        (path / "trackers.json").write_text(text)
        capsys.readouterr()
        assert main(["resume", str(path), "--steps", "300", "-q"]) == 2
        assert "trackers.json: damaged" in capsys.readouterr().err


def test_files_behind_a_link_are_left_alone(runs: Path, tmp_path: Path, capsys: Any) -> None:
    pytest.importorskip("tensorboardX")
    assert train(runs) == 0
    run = runs / "probe_envs-Scripted-v0" / "td3" / "0"
    other = tmp_path / "events.out.tfevents.1"
    other.touch()
    (run / "tensorboard").symlink_to(tmp_path)
    assert main(["resume", str(run), "--steps", "300", "--log", "tensorboard", "-q"]) == 2
    assert "is a link" in capsys.readouterr().err
    assert other.exists()


def test_bench_passes_it_on(runs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """To runs that it starts and to those that it resumes."""
    bench = ["bench", "--algos", "td3", "--envs", TASK, "--print", "commands", "--runs", str(runs)]
    assert main([*bench, "--log", "tensorboard"]) == 0
    line = capsys.readouterr().out
    assert line.count("--log=tensorboard -q") == 2
    assert main(bench) == 0
    assert "--log" not in capsys.readouterr().out


def test_a_number_that_is_none_gives_no_point() -> None:
    row = {"kind": "eval", "step": 1, "terms": {"reward_x": math.nan, "reward_y": math.inf}}
    assert numbers(row | {"mean": 2.0, "returns": [1.0, math.nan]}) == {
        "eval/mean": 2.0,
        "eval/returns/0": 1.0,
    }


def test_wandb_takes_a_step_as_a_whole(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """It drops what comes later for a step that it has, so a stopped run keeps back its last."""
    logged: list[tuple[int, dict[str, float]]] = []
    run = SimpleNamespace(log=lambda row, step: logged.append((step, row)), finish=lambda: None)
    tool = SimpleNamespace(init=lambda **given: run, Settings=lambda **given: None)
    monkeypatch.setattr("pacesetter.tracking.sinks.need", lambda *names: tool)

    def steps(rows: list[Row], new: list[Row]) -> list[int]:
        logged.clear()
        with SINKS["wandb"].open(Tracked(tmp_path, "a", "t", "g", {}, rows, False)) as write:
            for row in new:
                write(row)
        return [step for step, _ in logged]

    def row(kind: str, step: int) -> Row:
        return {"kind": kind, "step": step, "updates": 1}

    first = [row("eval", 0), row("train", 1000)]
    assert steps([], first) == [0]  # stopped within the evaluation of step 1000
    assert steps(first, [row("eval", 1000)]) == [0, 1000, 1000]
