"""`bench`: what a suite expands to, and that every run is made once, whatever happens."""

import errno
import fcntl
import json
import os
import platform
import re
import runpy
import signal
import stat
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import Any

import broken_envs
import numpy as np
import pytest
from odd_places import folder, pipe
from short_runs import assert_same
from stopping import wait_for

from pacesetter import algorithms
from pacesetter.cli import bench_progress
from pacesetter.cli.flags import add_settings, parser, split_env_kwargs
from pacesetter.cli.main import main
from pacesetter.config import Config, Run, resolve
from pacesetter.errors import UsageError
from pacesetter.runs import RunDirectory, find_all
from pacesetter.settings.budget import steps_per_count
from pacesetter.study.bench import executors, suite
from pacesetter.study.bench import queue as bench_module
from pacesetter.study.bench.executors import Local, run_command
from pacesetter.study.bench.queue import RETRIES, Bench, Outcome, is_finished
from pacesetter.study.bench.suite import Job, expand, load
from pacesetter.training.trainer import Trainer

PROBE = "broken_envs:Probe-v0"
SMALL: dict[str, Any] = {
    "hidden": [16, 16],
    "batch_size": 16,
    "replay_size": 10_000,
    "warmup": 100,
    "eval_every": 200,
    "eval_episodes": 1,
    "steps": 400,
}
SUITE = "".join(f"{key} = {json.dumps(value)}\n" for key, value in SMALL.items())
SUITE = f"""envs = ["{PROBE}"]\n{SUITE}
[entries.td3]
[entries.td3-2x]
algorithm = "td3"
updates_per_step = 2
"""


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Commands run in an empty folder, and theirs find this folder's tasks."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(bench_module, "POLL", 0.01)
    path = [str(Path(broken_envs.__file__).parent), os.environ.get("PYTHONPATH", "")]
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))  # for the locks of cores
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(path))
    return tmp_path


@pytest.fixture
def jobs(here: Path) -> list[Job]:
    """Two runs of one seed."""
    (here / "suite.toml").write_text(SUITE)
    return expand(load("suite.toml"), {}, "runs")


# Suites.


def entries() -> Iterator[Any]:
    for name in suite.shipped():
        for entry in load(name).entries:
            yield pytest.param(name, entry, id=f"{name}-{entry}")


def parsed(words: list[str]) -> Config:
    """The settings of a `train` command line, as the command line itself reads them."""
    _, algorithm, env, *flags = words
    defaults = resolve(algorithm, env).settings()
    command = parser("train", "")
    add_settings(command, "run", Run, defaults)
    add_settings(command, "its own", algorithms.find(defaults["algorithm"]).Hyper, defaults)
    command.add_argument("--runs")
    rest, env_kwargs = split_env_kwargs(flags)
    found = vars(command.parse(rest))
    found.pop("runs")
    return resolve(algorithm, env, found, {"env_kwargs": env_kwargs})


@pytest.mark.parametrize(("name", "entry"), [*entries()])
def test_every_entry_settles(name: str, entry: str) -> None:
    """And its command line says the same."""
    found = expand(suite.pick(load(name), [entry]), {}, "runs")
    assert found
    for job in found:
        if job.config.run.seed == 0:
            assert parsed(job.words) == job.config
        assert job.directory.path.parts[-2:] == (entry, str(job.config.run.seed))


TASKS = ("HalfCheetah-v4", "Walker2d-v4", "pacesetter/Ant111-v4")


def budgets(name: str) -> dict[tuple[str, str, int], int]:
    """Env steps of each run of a shipped suite by task, name and seed."""
    runs = [job.config.run for job in expand(load(name), {}, "runs")]
    return {(run.env, run.name, run.seed): run.steps for run in runs}


def test_paper_table_1() -> None:
    names = ("multi-td3", "sunrise", "sac")
    wanted = {(env, name, seed): 50_000 for env in TASKS for name in names for seed in range(3)}
    assert budgets("paper-table-1") == wanted
    found = expand(load("paper-table-1"), {}, "runs")
    assert {job.config.hyper.warmup for job in found} == {10_000}


def test_paper_table_2() -> None:
    """A million steps, both readings of multi-td3 on HalfCheetah, controls on Walker2d."""
    names = ("td3", "multi-td3")
    wanted = {(env, name, seed): 10**6 for env in TASKS for name in names for seed in range(3)}
    wanted |= {("HalfCheetah-v4", "multi-td3", seed): 2 * 10**6 for seed in range(3)}
    for name in ("multi-td3-none", "multi-td3-random"):
        wanted |= {("Walker2d-v4", name, seed): 500_000 for seed in range(3)}
    assert budgets("paper-table-2") == wanted
    found = {job.config.run.name: job.config.run for job in expand(load("paper-table-2"), {}, "r")}
    assert (found["multi-td3-none"].rule, found["multi-td3-random"].rule) == ("none", "random")


def test_settings_by_task_are_tables(here: Path) -> None:
    (here / "odd.toml").write_text('envs = ["Pendulum-v1"]\n[entries.td3]\nenv = "Pendulum-v1"\n')
    with pytest.raises(UsageError, match="env: must be tables of settings by task"):
        expand(load("odd.toml"), {}, "runs")


def test_pilot() -> None:
    runs = [job.config.run for job in expand(load("pilot"), {}, "runs")]
    steps = {run.name: run.steps for run in runs}
    assert steps == {
        "td3": 100_000,
        "multi-td3": 200_000,
        "td3-2x": 100_000,
        "multi-td3-none": 100_000,
        "multi-td3-random": 100_000,
        "td3-norm": 100_000,
        "multi-td3-norm": 100_000,
        "sunrise-30k": 30_000,
        "sac-30k": 30_000,
        "td3-30k": 30_000,
    }
    assert {run.env for run in runs} == {"HalfCheetah-v4"}
    assert {run.algorithm for run in runs if run.name == "sunrise-30k"} == {"sunrise"}
    assert len(runs) == suite.count(load("pilot")) == 7 * 3 + 3 * 2


def test_flags_over_entry_over_file_over_suite(here: Path) -> None:
    """A file of settings may be one for each task; that of another run may be given too."""
    (here / "best-Ant-v5.toml").write_text("gamma = 0.2\ntau = 0.2\nbatch-size = 22\n")
    (here / "best-Walker2d-v5.toml").write_text("gamma = 0.9\nseed = 7\nname = 'x'\n")
    (here / "suite.toml").write_text(
        'envs = ["Ant-v5", "Walker2d-v5"]\ngamma = 0.1\ntau = 0.1\nbatch_size = 11\nwarmup = 1\n'
        '[entries.tuned]\nalgorithm = "td3"\nconfig = "best-{env}.toml"\nbatch_size = 33\n'
        "seeds = [4]\n"
    )
    ant, walker = expand(load("suite.toml"), {"tau": "0.4"}, "runs")
    hyper = ant.config.hyper
    assert (hyper.warmup, hyper.gamma, hyper.batch_size, hyper.tau) == (1, 0.2, 33, 0.4)
    assert (walker.config.hyper.gamma, walker.config.run.seed) == (0.9, 4)
    assert str(walker) == "Walker2d-v5 tuned seed 4"


BAD_SUITES = {
    "envs = ['A-v0']": ["suite.toml", "entries"],
    "entries = 3": ["entries"],
    "[entries]\ntd3 = 3": ["entries.td3", "table"],
    "[entries.td3]": ["td3", "envs", "--envs"],
    "envs = 3\n[entries.td3]": ["envs", "list"],
    "envs = ['A-v0']\nseeds = 0\n[entries.td3]": ["seeds", "0"],
    "envs = ['A-v0']\nseeds = [2147483648]\n[entries.td3]": ["seeds", "2147483647", "tune"],
    "envs = ['A-v0']\nseeds = [-1]\n[entries.td3]": ["seeds"],
    "envs = ['A-v0']\nseeds = 2147483648\n[entries.td3]": ["seeds", "at most 1,000"],
    f"envs = ['A-v0']\nseeds = {[*range(1001)]}\n[entries.td3]": ["seeds", "at most 1,000"],
    "envs = ['A-v0']\nseeds = true\n[entries.td3]": ["seeds", "True"],
    "envs = ['A-v0']\ngama = 1\n[entries.td3]": ["entry td3", "gama", "gamma"],
    "envs = ['A-v0']\n[entries.td3]\ngamma = 2": ["entry td3", "gamma", "1", "2"],
    "envs = ['A-v0']\n[entries.td3]\nname = 'x'": ["entry td3", "name", "entry"],
    "envs = ['A-v0']\n[entries.td3]\nseed = 3": ["seed", "seeds"],
    "envs = ['A-v0']\n[entries.x]\nalgorithm = 'td4'": ["td4", "td3"],
    "envs = ['A-v0']\n[entries.x]\nalgorithm = 4": ["entries.x", "algorithm"],
    "envs = ['A-v0']\n[entries.td3]\nconfig = 'no.toml'": ["entry td3", "no.toml"],
    "envs = ['A-v0']\n[entries.td3]\nconfig = 3": ["config", "3"],
    "envs = ['NoSuch-v0']\n[entries.td3]": ["env", "NoSuch-v0"],
    "envs = ['A-v0'\n": ["suite.toml"],
    "envs = ['A-v0']\nalgorithm = 'x:Y'\n[entries.td3]": ["algorithm", "entry"],
    **{
        f"envs = ['A-v0']\n[entries.td3.env.'A-*']\n{key} = {value}": [key, "A-*"]
        for key, value in {
            "algorithm": "'x:Y'",
            "seeds": 3,
            "envs": ["B-v0"],
            "config": "'c'",
        }.items()
    },
}


@pytest.mark.parametrize("text", BAD_SUITES)
def test_bad_suite(text: str, here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One line, and nothing is written."""
    (here / "suite.toml").write_text(text)
    assert main(["bench", "suite.toml"]) == 2
    assert_refused(capsys, BAD_SUITES[text])


BAD_COMMANDS = {
    "pilto": ["suite", "pilto", "pilot"],
    "no.toml": ["no.toml", "smoke"],
    "": ["smoke", "--algos"],
    "--algos td3": ["envs"],
    "--algos tt3 --envs Ant-v5": ["tt3", "td3"],
    "smoke --algos tt3": ["tt3", "td3"],
    "smoke --jobs 0": ["jobs", "0"],
    "smoke --jobs x": ["jobs", "x"],
    "smoke --gama 1": ["--gama", "--gamma"],
    "smoke --algos td3 --policy-delay 0": ["policy_delay", "0"],
    "smoke --policy-delay 3": ["entry sac", "policy_delay"],
    "smoke --seed 3": ["seed", "seeds"],
    "smoke --seeds 2147483648 1": ["seeds", "tune"],
    "smoke --executor sun": ["executor", "sun", "ray"],
    "smoke --env.KEY": ["--env.KEY"],
    "smoke --address auto": ["address", "--executor ray"],
}


@pytest.mark.parametrize("words", BAD_COMMANDS)
def test_bad_command(words: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", *words.split()]) == 2
    assert_refused(capsys, BAD_COMMANDS[words])


def assert_refused(capsys: pytest.CaptureFixture[str], expected: list[str]) -> None:
    printed = capsys.readouterr()
    assert printed.out == ""
    assert re.fullmatch(r"pacesetter: [^\n]+\n", printed.err), printed.err
    assert [word for word in expected if word not in printed.err] == [], printed.err
    assert not Path("runs").exists()


def test_help_of_a_suite_has_the_settings_of_its_algorithms(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(SystemExit):
        main(["bench", "smoke", "--help"])
    text = capsys.readouterr().out
    flags = ["--jobs", "--members", "--policy-delay", "--initial-alpha", "--env.KEY", "--print"]
    assert [flag for flag in flags if flag not in text] == []


# The loop, in this process.

Action = int | Callable[[list[str]], int | Outcome] | None


class Here:
    """Runs a command in this process, unless an action is planned in its place."""

    slots = 1

    def __init__(self, *plan: Action) -> None:
        self.plan, self.calls, self.stopped = list(plan), list[str](), 0

    def start(self, slot: int, words: list[str]) -> Outcome:
        self.calls.append(words[0])
        action = self.plan.pop(0) if self.plan else None
        if action is None:
            return Outcome(main(words), "")
        result = action if isinstance(action, int) else action(words)
        said = "a line\npacesetter: the fault\n"
        return result if isinstance(result, Outcome) else Outcome(result, said)

    def poll(self, task: Outcome) -> Outcome:
        return task

    def stop(self, task: Outcome) -> None:
        self.stopped += 1

    kill = stop


def run(jobs: list[Job], executor: Any) -> Bench:
    work = Bench(jobs)
    for _ in work.run(executor):
        pass
    return work


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The runs of SUITE, each made by one command."""
    folder = tmp_path_factory.mktemp("undisturbed")
    (folder / "suite.toml").write_text(SUITE)
    for job in expand(load(str(folder / "suite.toml")), {}, folder):
        assert main([*job.words, "-q"]) == 0
    return folder


def assert_undisturbed(jobs: list[Job], undisturbed: Path) -> None:
    for job in jobs:
        path = job.directory.path.relative_to("runs")
        assert_same(RunDirectory(undisturbed / path), job.directory)


def stop_at(step: int) -> Callable[[list[str]], int]:
    """A run that is asked to save and end after a step."""

    def train(words: list[str]) -> int:
        given = parsed(words[:-1])
        settings = given.settings()
        names = settings.pop("algorithm"), settings.pop("env")
        for report in Trainer(*names, runs="runs", **settings):
            if report.step >= step:
                break
        return 143

    return train


def test_finished_runs_are_skipped(jobs: list[Job], undisturbed: Path) -> None:
    first = Here()
    work = run(jobs, first)
    assert (first.calls, work.before) == (["train", "train"], 0)
    assert work.finished == jobs
    assert_undisturbed(jobs, undisturbed)
    again = Here()
    work = run(jobs, again)
    assert (again.calls, work.before, work.failed) == ([], 2, {})


def test_saved_run_is_resumed(jobs: list[Job], undisturbed: Path) -> None:
    """However often it is asked to save."""
    executor = Here(stop_at(200), 143, 130, 143, 130)
    work = run(jobs, executor)
    assert executor.calls[0] == "train"
    assert sorted(executor.calls[1:]) == ["resume"] * 3 + ["train"] * 3
    assert (len(work.finished), work.failed) == (2, {})
    assert_undisturbed(jobs, undisturbed)


def killed_at_birth(words: list[str]) -> int:
    """A run with its config written and nothing else."""
    config = parsed(words[:-1])
    directory = RunDirectory.of("runs", config)
    directory.create(config)
    directory.unlock()
    return -9


def test_broken_run_is_resumed(jobs: list[Job], undisturbed: Path) -> None:
    executor = Here(killed_at_birth)
    directory = jobs[0].directory
    work = run(jobs[:1], executor)
    assert executor.calls == ["train", "resume"]
    assert work.finished == jobs[:1]
    assert "trying again" in "".join(work.news)
    assert_same(RunDirectory(undisturbed / directory.path.relative_to("runs")), directory)


@pytest.mark.parametrize(("code", "calls"), [(2, 1), (1, 3), (-9, 3), (-11, 3), (0, 3)])
def test_failures(code: int, calls: int, jobs: list[Job]) -> None:
    """Bad input is never retried, all else twice; the others go on; exit 0 unfinished is none."""
    executor = Here(code, None, *[code] * (calls - 1))
    work = run(jobs, executor)
    assert len(executor.calls) == calls + 1
    assert work.failed == {str(jobs[0]): f"exit {code}: the fault"}
    assert work.finished == jobs[1:]


def test_two_failures_are_forgiven(jobs: list[Job]) -> None:
    work = run(jobs[:1], executor := Here(1, -9))
    assert len(executor.calls) == 3
    assert (work.finished, work.failed) == (jobs[:1], {})


def test_failure_is_reported(
    jobs: list[Job], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its last line, its whole output in a file of its folder, and exit code 1."""
    monkeypatch.setattr(
        "pacesetter.study.bench.executors.Local", lambda slots: Here(killed_at_birth, 2)
    )
    assert main(["bench", "suite.toml", "--algos", "td3"]) == 1
    printed = capsys.readouterr()
    assert "0 of 1 runs finished, 0 of them before; 1 failed" in printed.out
    assert printed.err.splitlines()[-1] == f"pacesetter: {PROBE} td3 seed 0: exit 2: the fault"
    text = (jobs[0].directory.path / "failure.log").read_text()
    assert re.fullmatch(
        rf"\$ resume runs/\S+ --allow {PROBE} -q\na line\npacesetter: the fault\n", text
    )


def test_locked_run_is_left_to_its_holder(jobs: list[Job]) -> None:
    """And looked at again when it is free."""
    holder = jobs[0].directory
    holder.state_file.parent.mkdir(parents=True)
    holder.lock()
    work = Bench(jobs)
    steps = work.run(executor := Here())
    for _ in range(5):
        next(steps)
    assert (executor.calls, work.finished) == (["train"], jobs[1:])
    waiting = f"in use by process {os.getpid()} on {platform.node()}; will retry"
    assert sum(waiting in line for line in work.news) == 1
    holder.unlock()
    for _ in steps:
        pass
    assert len(work.finished) == 2


def test_run_of_another_machine_is_not_failed(
    jobs: list[Job], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without locks nobody can tell whether it lives; the bench waits, and says what to do."""

    def no_locks(*arguments: Any) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", no_locks)
    lock = jobs[0].directory.path / "lock"
    lock.parent.mkdir(parents=True)
    lock.write_text("process 1 on elsewhere\n")
    work = Bench(jobs)
    executor = Here(lambda words: lock.unlink() or main(words))
    for _ in work.run(executor):
        pass
    assert (len(work.finished), work.failed) == (2, {})
    assert any("process 1 on elsewhere" in x and f"remove {lock};" in x for x in work.news)


def test_a_quiet_bench_names_the_run_that_it_waits_for(
    jobs: list[Job], capsys: pytest.CaptureFixture[str]
) -> None:
    jobs[0].directory.state_file.parent.mkdir(parents=True)
    jobs[0].directory.lock()
    work = Bench(jobs[:1])
    with bench_progress.display(work, quiet=True) as show:
        steps = work.run(Here())
        for _ in range(3):
            next(steps)
            show(work)
        jobs[0].directory.unlock()
        for _ in steps:
            show(work)
    said = f"pacesetter: {jobs[0]}: in use by process {os.getpid()} on {platform.node()}\n"
    assert capsys.readouterr().err.count(said) == 1


def test_run_that_another_was_quicker_with(jobs: list[Job]) -> None:
    """A command that met another process's run has not failed; its code says so, not its words."""

    def overtaken(words: list[str]) -> int:
        stop_at(200)(words)
        return main(words)

    def in_use(words: list[str]) -> int:
        jobs[0].directory.lock()
        code = main(words)
        jobs[0].directory.unlock()
        return code

    work = run(jobs[:1], executor := Here(overtaken, in_use))
    assert executor.calls == ["train", "resume", "resume"]
    assert (work.finished, work.failed) == (jobs[:1], {})


def test_words_of_a_command_decide_nothing(jobs: list[Job]) -> None:
    """A task may say what it likes; bad input stays bad input."""
    work = run(jobs[:1], executor := Here(lambda words: Outcome(2, "the robot is in use by me")))
    assert executor.calls == ["train"]
    assert work.failed == {str(jobs[0]): "exit 2: the robot is in use by me"}


def test_a_run_in_use_by_nobody_is_not_tried_for_ever(jobs: list[Job]) -> None:
    """Exit 75 counts while a process has the lock."""
    work = run(jobs[:1], executor := Here(*[lambda words: Outcome(75, "in use")] * 9))
    assert len(executor.calls) == 3
    assert work.failed == {str(jobs[0]): "exit 75: in use"}


DAMAGES: dict[str, Callable[[Path], object]] = {
    "pipe": pipe,
    "folder": folder,
    "no JSON": lambda path: path.write_text("{"),
    "no UTF-8": lambda path: path.write_bytes(b"\xff"),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_run_spoils_no_other(
    damage: str, jobs: list[Job], capsys: pytest.CaptureFixture[str]
) -> None:
    """It is named at once and at the end; the others are made."""
    stop_at(200)(jobs[0].words)
    DAMAGES[damage](jobs[0].directory.config_file)
    work = Bench(jobs)
    assert [job for job in jobs if str(job) not in work.failed] == jobs[1:] == work.left
    assert "config.json" in work.failed[str(jobs[0])]
    assert sum("config.json" in line for line in work.news) == 1
    for _ in work.run(executor := Here()):
        pass
    assert (executor.calls, work.finished) == (["train"], jobs[1:])
    capsys.readouterr()
    assert main(["bench", "suite.toml", "--print", "commands"]) == 1
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.count("\n") == 1
    assert "config.json" in printed.err


ODD_ROWS = (
    "3",
    "[]",
    "{}",
    '{"kind": "eval", "step": "x"}',
    '{"kind": "eval", "step": 7, "mean": "x"}',
)


@pytest.mark.parametrize("row", ODD_ROWS)
def test_an_odd_row_spoils_no_progress(
    row: str, jobs: list[Job], capsys: pytest.CaptureFixture[str]
) -> None:
    """Nor the list of runs, whose other lines stay."""
    stop_at(200)(jobs[0].words)
    stop_at(200)(jobs[1].words)
    with jobs[0].directory.metrics_file.open("a") as log:
        log.write(f"{row}\n")
    work = Bench(jobs)
    with bench_progress.display(work) as show:
        show(work)
    capsys.readouterr()
    assert main(["list", "runs"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert any(str(jobs[0].directory.path) in line for line in lines)
    assert any(str(jobs[1].directory.path) in line and "stopped" in line for line in lines)
    assert main(["show", str(jobs[0].directory.path)]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_a_failure_that_cannot_be_written_spoils_no_other(jobs: list[Job]) -> None:
    (jobs[0].directory.path / "failure.log").mkdir(parents=True)
    work = run(jobs, executor := Here(lambda words: Outcome(2, "the fault")))
    assert executor.calls == ["train", "train"]
    assert [*work.failed] == [str(jobs[0])]
    assert any("cannot write" in line and "failure.log" in line for line in work.news)
    assert work.finished == jobs[1:]


def test_run_of_other_settings_is_refused(
    jobs: list[Job], capsys: pytest.CaptureFixture[str]
) -> None:
    """Before anything starts, in one line that names the run and the setting."""
    run(jobs[1:], Here())
    capsys.readouterr()
    for flag, value in {"--tau": "0.3", "--steps": "500"}.items():
        assert main(["bench", "suite.toml", flag, value]) == 2
        printed = capsys.readouterr()
        assert printed.err.count("\n") == 1
        assert f"td3-2x/0 exists with {flag[2:]}=" in printed.err
    assert [found.path for found in find_all("runs")] == [jobs[1].directory.path]


def test_settings_without_a_result_stop_no_study(jobs: list[Job]) -> None:
    """A run that goes on takes them anew."""
    run(jobs[1:], Here())
    flags = {"env_timeout": "30s", "checkpoint_every": 9.0, "device": "cpu"}
    again = expand(load("suite.toml"), flags, "runs")
    work = Bench(again)
    assert (work.before, work.failed) == (1, {})
    words = bench_module.words_of(again[1])
    assert words[0] == "resume"
    assert {"--env-timeout=30s", "--checkpoint-every=9.0"} < {*words}
    assert "--device=cpu" in words


def test_stop_waits_for_all_and_starts_none(jobs: list[Job]) -> None:
    work = Bench(jobs)
    executor = Here(lambda words: work.stop() or stop_at(200)(words))
    for _ in work.run(executor):
        pass
    assert (executor.calls, executor.stopped) == (["train"], 1)
    assert work.finished == []
    assert jobs[0].directory.config_file.exists()
    assert not jobs[1].directory.config_file.exists()


def test_finished_is_what_the_checkpoint_says(jobs: list[Job]) -> None:
    """The log may be ahead of it."""
    job = jobs[0]
    assert not is_finished(job)
    stop_at(200)([*job.words, "-q"])
    assert not is_finished(job)
    log = job.directory.metrics_file.read_text()
    job.directory.metrics_file.write_text(log + json.dumps({"kind": "eval", "step": 400}) + "\n")
    assert not is_finished(job)
    assert main(["resume", str(job.directory.path), "-q"]) == 0
    assert is_finished(job)
    job.directory.state_file.write_bytes(job.directory.state_file.read_bytes()[:-5])
    assert not is_finished(job)


# What people see.


def test_lines_without_a_terminal(jobs: list[Job], capsys: pytest.CaptureFixture[str]) -> None:
    work = Bench(jobs)
    with bench_progress.display(work) as show:
        for _ in work.run(Here()):
            show(work)
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 4
    assert lines[0].startswith(f"{PROBE} td3 seed 0: train  [")
    assert re.fullmatch(
        rf"{PROBE} td3-2x seed 0: finished  \[2 of 2 runs  step 800 of 800  ETA 0:00:00\]",
        lines[-1],
    )


def test_bars_on_a_terminal(
    jobs: list[Job], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """One for all, one a running run; failed runs are not waited for."""
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    monkeypatch.setattr(bench_progress, "LOOK_EVERY", 0.0)
    monkeypatch.setenv("COLUMNS", "160")
    work = Bench(jobs)
    with bench_progress.display(work) as show:
        for _ in work.run(Here(2)):
            show(work)
    text = capsys.readouterr().err
    assert f"{PROBE} td3-2x seed 0" in text
    assert "400/400" in text
    assert "1 of 2 runs" in text


def test_list_suites(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["list", "suites"]) == 0
    text = capsys.readouterr().out
    for name in ("paper-table-1", "paper-table-2", "smoke", "published", "pilot"):
        assert re.search(rf"^{name} +\d+ runs +\w", text, re.MULTILINE), name


# On paper.


@pytest.fixture
def program(here: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """In place of Python: it notes its words and the thread count, and exits as it is told."""
    log = here / "calls"
    path = here / "python stub"
    path.write_text(f'#!/bin/bash\necho "$NPROC $*" >> "{log}"\nexit ${{CODE:-0}}\n')
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setattr(sys, "executable", str(path))
    return log


def test_printed_commands(
    jobs: list[Job], program: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Each begins a run or goes on with it, whichever is due when it is called."""
    assert main(["bench", "suite.toml", "--print", "commands"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 2
    assert not Path("runs").exists()
    subprocess.run(["bash", "-c", lines[1]], check=True)
    jobs[1].directory.create(jobs[1].config)
    jobs[1].directory.unlock()
    subprocess.run(["bash", "-c", lines[1]], check=True)
    train, resume = program.read_text().splitlines()
    assert train == " ".join(["1 -m pacesetter", *jobs[1].words, "-q"])
    assert resume == f"1 -m pacesetter resume {jobs[1].directory.path} --allow {PROBE} -q"


def test_a_job_array_has_the_whole_name_of_its_suite(jobs: list[Job]) -> None:
    assert "#SBATCH --job-name='my suite.v2'\n" in executors.slurm("my suite.v2", jobs)


def test_a_wrapper_that_cannot_be_made_stops_the_bench(here: Path) -> None:
    """Also where another entry has the same task without it."""
    own = {"envs": [PROBE], "seeds": 1, "wrap": ["odd_envs:MuteWrapper"]}
    both = suite.of_algorithms(["td3", "sac"])
    both = both._replace(entries={"sac": own, "td3": {"envs": [PROBE]}}, allow=own["wrap"])
    with pytest.raises(UsageError, match="MuteWrapper"):
        Bench(expand(both, {}, "runs")).check_envs()


def test_printed_job_array(
    here: Path, jobs: list[Job], program: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A task runs its own command; a run that saved is queued again, one that failed is not."""
    assert main(["bench", "suite.toml", "--print", "slurm"]) == 0
    text = capsys.readouterr().out
    assert "#SBATCH --array=0-1\n" in text
    assert "#SBATCH --job-name=suite\n" in text
    (here / "array.sh").write_text(text)
    for name, body in {"srun": '"$@"', "scontrol": 'echo "$*" >> requeued'}.items():
        (here / name).write_text(f"#!/bin/bash\n{body}\n")
        (here / name).chmod(0o755)
    environment = {"PATH": f"{here}:/usr/bin:/bin", "SLURM_ARRAY_JOB_ID": "12"}
    for code in (0, 143, 75):
        task = {"SLURM_ARRAY_TASK_ID": "1", "CODE": str(code)}
        done = subprocess.run(["bash", "array.sh"], env=environment | task)
        assert done.returncode == code
    assert (
        program.read_text().splitlines()
        == [" ".join(["1 -m pacesetter", *jobs[1].words, "-q"])] * 3
    )
    assert (here / "requeued").read_text() == "requeue 12_1\n"


def test_finished_runs_are_not_printed(jobs: list[Job], capsys: pytest.CaptureFixture[str]) -> None:
    run(jobs[:1], Here())
    capsys.readouterr()
    assert main(["bench", "suite.toml", "--print", "commands"]) == 0
    (line,) = capsys.readouterr().out.splitlines()
    assert "td3-2x" in line
    run(jobs, Here())
    capsys.readouterr()
    assert main(["bench", "suite.toml", "--print", "commands"]) == 0
    assert capsys.readouterr() == ("", "pacesetter: every run has finished\n")


# With processes.


def start(*words: str) -> subprocess.Popen[str]:
    """A bench as a process of its own."""
    command = [sys.executable, "-m", "pacesetter", "bench", *words, "--allow", PROBE]
    return subprocess.Popen(command, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE)


def test_interrupted_bench_saves_all_and_goes_on(jobs: list[Job]) -> None:
    """Ctrl-C reaches each run once; the next call ends them; the runs were pinned to a core."""
    long = ["--steps", "1M", "--eval-every", "1M", "--warmup", "1M", "--replay-size", "1k"]
    long += ["--jobs", "2"]
    process = start("suite.toml", *long)
    logs = [job.directory.metrics_file for job in jobs]
    wait_for(lambda: all(log.exists() and '"train"' in log.read_text() for log in logs), process)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=120)
    assert process.returncode == 130, err
    assert "0 of 2 runs finished" in out
    assert "saved; go on with `pacesetter bench suite.toml --steps 1M" in out
    assert err.count(": stopped") == 2
    for job in jobs:
        assert not job.directory.in_use()
        record = job.directory.record()
        assert record["threads"] == 1
        assert f", 1 of {os.cpu_count()} cores" in record["machine"]
        trainer = Trainer.resume(job.directory.path)  # it starts where the signal came
        # Nothing was lost; this process may only have other threads than the run.
        assert all("threads" in note for note in trainer.notes)
        assert 0 < trainer.progress.step < 1_000_000
        assert trainer.progress.step >= job.directory.rows()[-1]["step"]
        trainer.close()


HANGS = """
import time
from pathlib import Path
import gymnasium
class Hangs(gymnasium.Env):
    observation_space = gymnasium.spaces.Box(-1, 1, (2,))
    action_space = gymnasium.spaces.Box(-1, 1, (1,))
    def reset(self, **options):
        Path("hangs").touch()
        while True:
            time.sleep(1)
gymnasium.register("Hangs-v0", entry_point=Hangs)
"""


def test_second_interrupt_ends_a_hung_run(here: Path) -> None:
    """The first waits for it to save, which it never does; no process is left behind."""
    (here / "hangs.py").write_text(HANGS)
    process = start("--algos", "td3", "--envs", "hangs:Hangs-v0", "-q")
    wait_for(Path("hangs").exists, process)
    (child,) = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    process.send_signal(signal.SIGINT)
    time.sleep(0.5)
    assert process.poll() is None
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=60)  # of a task that never comes back
    assert process.returncode == 130
    wait_until(lambda: not Path(f"/proc/{child}").exists())


def wait_until(what: Callable[[], object]) -> None:
    end = time.monotonic() + 60
    while not what():
        assert time.monotonic() < end
        time.sleep(0.01)


def test_bench_of_processes(jobs: list[Job], undisturbed: Path) -> None:
    """Without a folder of the suite's runs, with one, and what a failing command says."""
    work = run(jobs, Local(2))
    assert (len(work.finished), work.failed) == (2, {})
    bad = Job(jobs[0].config, RunDirectory(Path("runs/none")), ["train", "td3", "NoSuch-v0"])
    (failure,) = run([bad], Local(1)).failed.values()
    assert failure.startswith("exit 2: env: unknown 'NoSuch-v0'")


RAY_CANCELS = """
import _thread, signal, sys, threading, time
from pathlib import Path
signal.signal(signal.SIGINT, signal.SIG_IGN)  # as in what a script starts in the background
from pacesetter.study.bench.executors import run_command

def cancel():
    while not Path(sys.argv[1]).exists():
        time.sleep(0.05)
    _thread.interrupt_main()

threading.Thread(target=cancel, daemon=True).start()
print(run_command(sys.argv[2:], ".")[0])
"""


def test_cancelled_task_saves_where_interrupts_are_ignored(jobs: list[Job]) -> None:
    """Ray cancels by an interrupt, and a cluster may have been started without them."""
    words = [*jobs[0].words, "--steps=1000000", "--warmup=1000000", "--eval-every=1000000", "-q"]
    log = jobs[0].directory.metrics_file
    done = subprocess.run(
        [sys.executable, "-c", RAY_CANCELS, str(log), *words],
        capture_output=True, text=True, timeout=60,
    )  # fmt: skip
    assert done.stdout.strip() == "143", done.stderr
    assert not jobs[0].directory.in_use()


def test_ray_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    from pacesetter.study.bench.executors import Ray

    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(UsageError, match=r"ray is not installed; pip install .*\[scale\]"):
        Ray(None, None)


# Kills, and clusters.

MANY = f"""envs = ["Pendulum-v1"]
seeds = 20
{SUITE.split(chr(10), 1)[1].split("[entries", 1)[0]}
checkpoint_every = 0.2
[entries.td3]
[entries.multi-td3]
""".replace("steps = 400", "steps = 1500")
KILLS = 24


def children(process: subprocess.Popen[str]) -> list[tuple[int, str]]:
    """Process numbers and command lines of a bench's runs (Linux)."""
    found: list[tuple[int, str]] = []
    for path in Path("/proc").glob("[0-9]*"):
        try:
            parent = int(re.sub(r".*\) ", "", (path / "stat").read_text()).split()[1])
            if parent == process.pid:
                found.append((int(path.name), (path / "cmdline").read_text()))
        except (OSError, ValueError):
            continue
    return found


def run_of(command: str) -> tuple[str, str]:
    """Name and seed of the run that a command line begins or resumes."""
    words = command.split("\0")
    place = next(i for i, word in enumerate(words) if word in ("train", "resume"))
    if words[place] == "resume":
        return tuple(Path(words[place + 1]).parts[-2:])
    (seed,) = [word.removeprefix("--seed=") for word in words if word.startswith("--seed=")]
    return words[place + 1], seed


@pytest.mark.slow
def test_bench_under_kills_equals_undisturbed(here: Path) -> None:
    """40 runs; workers are killed at any moment, no run more often than is forgiven, and so is the
    bench, twice; what it leaves behind goes on beside the next one."""
    (here / "many.toml").write_text(MANY)
    rng = np.random.default_rng(5)
    killed: Counter[tuple[str, str]] = Counter()
    process = start("many.toml", "--jobs", "2", "--runs", "killed")
    for number in range(KILLS):
        while True:
            time.sleep(float(rng.uniform(0.2, 3.0)))
            assert process.poll() is None, process.communicate()
            targets = [(pid, run_of(text)) for pid, text in children(process) if "-q" in text]
            targets = [(pid, run) for pid, run in targets if killed[run] < RETRIES]
            if targets:
                break
        pid, victim = targets[rng.integers(len(targets))]
        os.kill(pid, signal.SIGKILL)
        killed[victim] += 1
        if number in (KILLS // 3, 2 * KILLS // 3):
            process.kill()
            process.communicate()
            process = start("many.toml", "--jobs", "2", "--runs", "killed")
    out, err = process.communicate(timeout=900)
    assert process.returncode == 0, err
    assert "40 of 40 runs finished" in out
    assert out.endswith("0 failed\n")
    assert killed.total() == KILLS
    again = start("many.toml", "--runs", "killed")
    assert again.communicate()[0].startswith("40 of 40 runs finished, 40 of them before")
    undisturbed = start("many.toml", "--jobs", "2", "--runs", "whole")
    assert undisturbed.communicate(timeout=900)[0].startswith("40 of 40 runs finished, 0 of")
    whole = [*find_all("whole")]
    assert len(whole) == 40
    for one in whole:
        other = RunDirectory("killed" / one.path.relative_to("whole"))
        assert_same(one, other)
        budget_spent = [row for row in other.rows() if row["step"] >= 1500]
        assert sorted(row["kind"] for row in budget_spent if row["kind"] != "select") == [
            "eval",
            "train",
        ]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_ray_cluster(jobs: list[Job]) -> None:
    """Two nodes: a task a run; a lost command is tried again; stopping saves, and all goes on."""
    pytest.importorskip("ray", reason="ray is not installed: pip install 'pacesetter[scale]'")
    from ray.cluster_utils import Cluster

    from pacesetter.study.bench.executors import Ray

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    try:
        cluster.add_node(num_cpus=1)
        executor = Ray(None, cluster.address)
        assert executor.slots == 2
        long = {"steps": 10**8, "eval_every": 10**6, "warmup": 10**6, "replay_size": 1000}
        endless = expand(load("suite.toml"), long, "long")
        work = Bench(endless)
        logs = [job.directory.metrics_file for job in endless]
        killed = False
        for _ in work.run(executor):
            ready = all(log.exists() and '"train"' in log.read_text() for log in logs)
            if ready and not killed:
                holder = (endless[0].directory.path / "lock").read_text().split()[1]
                os.kill(int(holder), signal.SIGKILL)
                killed = True
            if "trying again" in "".join(work.news) and endless[0].directory.in_use():
                work.stop()
        assert [job.directory.in_use() for job in endless] == [False, False], work.news
        assert sum("stopped" in line for line in work.news) == 2, work.news
        trainer = Trainer.resume(endless[1].directory.path)  # the one that nobody killed
        assert trainer.progress.step >= 1_000
        trainer.close()
        work = run(jobs, executor)
        assert (len(work.finished), work.failed) == (2, {})
        assert run(jobs, executor).before == 2
    finally:
        import ray

        ray.shutdown()
        cluster.shutdown()


def results_suite(name: str) -> list[Any]:
    """The runs of a suite of results/."""
    return expand(load(str(Path(__file__).parents[2] / "results" / name)), {}, "runs")


def test_every_suite_of_the_results_can_be_run_and_collected() -> None:
    """Its settings are known, and `results/summary.py` has a study of its name."""
    results = Path(__file__).parents[2] / "results"
    files = list(results.glob("*.toml"))
    assert len(files) > 10
    assert all(results_suite(file.name) for file in files)
    assert {file.stem for file in files} <= runpy.run_path(str(results / "summary.py"))[
        "STUDIES"
    ].keys()


def spent(config: Any) -> tuple[int, float, int]:
    """Env steps of all members, updates of each, and evaluations."""
    run, hyper = config
    updates = (config.budget - hyper.warmup) / run.members * hyper.updates_per_step
    every = run.eval_every * steps_per_count(config.settings())
    return config.budget, updates, config.budget // every


def test_arms_of_the_ensemble_suite_spend_what_it_says() -> None:
    """Two members make the env steps of `single`, and together its updates less those of 5k."""
    for job in results_suite("ensemble.toml"):
        run, _ = job.config
        whole = 100_000 if run.env == "HalfCheetah-v4" else 200_000
        assert (run.members > 1) != run.wait
        assert (run.mean_actions, run.eval_episodes) == ("on", 10)
        halves = (whole, (whole - 10_000) / 2, whole // 10_000)
        alone = (whole, whole - 5_000, whole // 5_000)
        assert spent(job.config) == (alone if run.name == "single" else halves), run.name


def test_arms_of_the_suite_that_varies_gamma_spend_what_it_says() -> None:
    """Four members make the steps and updates of four fixed runs."""
    for job in results_suite("vary.toml"):
        run, _ = job.config
        members = 4 if run.name.startswith("vary") else 1
        assert (run.members, run.eval_episodes) == (members, 10)
        assert (members > 1) != run.wait
        assert (members > 1) == (run.mean_actions == "on")
        assert spent(job.config) == (members * 100_000, 95_000, 10), run.name


LEAVES = """#!/bin/sh
sleep 600 &
echo $!
"""


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="no run can be pinned")
def test_benches_share_the_cores_out(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two of one run each take a core each; where none is left, the slot says which is shared."""
    (here / "python").write_text("#!/bin/sh\nwhile [ ! -e over ]; do sleep 0.01; done\n")
    (here / "python").chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(here / "python"))
    monkeypatch.setattr(executors, "cores", lambda: [4, 7])
    pinned: list[int] = []
    monkeypatch.setattr(executors, "_pinned", lambda core: pinned.append(core) or nullcontext())
    benches = [Local(1), Local(1), Local(2)]
    tasks = [bench.start(0, []) for bench in benches]
    tasks.append(benches[2].start(1, []))
    assert pinned == [4, 7, 4, 7]
    (here / "over").touch()
    for bench, task in zip((*benches, benches[2]), tasks, strict=True):
        wait_until(partial(bench.poll, task))
    both = Local(2)
    again = [both.start(slot, []) for slot in (1, 0)]
    assert pinned[4:] == [7, 4]
    for task in again:
        wait_until(partial(both.poll, task))


@pytest.mark.parametrize("where", ["local", "ray"])
def test_what_a_crashed_run_leaves_running_is_ended(
    where: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program = tmp_path / "python"
    program.write_text(LEAVES)
    program.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(program))
    if where == "ray":
        before = signal.getsignal(signal.SIGINT)
        outcome = Outcome(*run_command(["train"], str(tmp_path)))
        signal.signal(signal.SIGINT, before)
    else:
        executor = Local(1)
        task = executor.start(0, ["train"])
        while (found := executor.poll(task)) is None:
            time.sleep(0.01)
        outcome = found
    end = time.monotonic() + 5
    while Path(f"/proc/{int(outcome.output)}").exists():
        assert time.monotonic() < end
        time.sleep(0.01)
    assert outcome.code == 0


def test_settings_of_a_task_hold_for_its_id_without_a_version(here: Path) -> None:
    text = '[entries.td3]\n[entries.td3.env."Pendulum-*"]\nsteps = 3_000\n'
    (here / "short.toml").write_text(text)
    (job,) = expand(load("short.toml"), {"envs": ["Pendulum", "Pendulum-v1"]}, "runs")
    assert (job.config.run.env, job.config.run.steps) == ("Pendulum-v1", 3_000)


@pytest.mark.parametrize(
    ("entry", "flags", "steps"),
    [
        ("", {}, 2_000),
        ("steps = 3_000", {}, 3_000),
        ('config = "mine.toml"', {}, 4_000),
        ('[entries.td3.env."Pendulum-*"]\nsteps = 5_000', {}, 5_000),
        ("steps = 3_000", {"steps": 6_000}, 6_000),
    ],
)
def test_settings_of_all_entries_for_a_task(
    here: Path, entry: str, flags: dict[str, Any], steps: int
) -> None:
    """They win over the suite's for all tasks, and lose to a file, an entry and flags."""
    (here / "mine.toml").write_text("steps = 4_000")
    (here / "own.toml").write_text(
        'steps = 1_000\nenvs = ["Pendulum-v1", "MountainCarContinuous-v0"]\n'
        f'[env."Pendulum-*"]\nsteps = 2_000\n[entries.td3]\n{entry}\n'
    )
    jobs = {job.config.run.env: job.config.run.steps for job in expand(load("own.toml"), flags, "")}
    assert jobs["Pendulum-v1"] == steps
    if not entry:
        assert jobs["MountainCarContinuous-v0"] == 1_000


@pytest.mark.parametrize("where", ["env", "entries.td3.env"])
def test_what_is_for_all_tasks_cannot_be_of_one(here: Path, where: str) -> None:
    (here / "own.toml").write_text(f'[entries.td3]\n[{where}."Pendulum-*"]\nseeds = 2\n')
    with pytest.raises(UsageError, match=r"seeds: is for all tasks; it cannot stand in env"):
        expand(load("own.toml"), {"envs": ["Pendulum-v1"]}, "")


def test_a_keyword_of_none_stays_none(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["bench", "--algos", "td3", "--envs", "Pendulum-v1", "--seeds", "1", "--print"]
    assert main([*words, "commands", "--env.render_mode", "none"]) == 0
    line = capsys.readouterr().out
    assert "--env.render_mode=none" in line
    assert "null" not in line


@pytest.mark.parametrize("value", [float("inf"), [0.5, float("-inf")], {"a": None}, "a 🦿", 1e-9])
def test_a_keyword_is_the_same_in_a_runs_command(value: Any) -> None:
    flags = {"envs": ["Pendulum-v1"], "env_kwargs": {"key": value}}
    (job,) = expand(suite.of_algorithms(["td3"]), flags, "runs")
    assert parsed(job.words).run.env_kwargs == {"key": value}


def test_an_algorithm_of_the_current_folder(
    here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "path", [*sys.path])
    (here / "mine_of_bench.py").write_text("from pacesetter.algorithms.td3 import TD3 as Learner")
    words = ["bench", "--algos", "mine_of_bench:Learner", "--envs", "Pendulum-v1", "--seeds", "1"]
    assert main([*words, "--print", "commands"]) == 0
    assert "train mine_of_bench:Learner Pendulum-v1" in capsys.readouterr().out


def test_keywords_are_merged_one_by_one(here: Path) -> None:
    """Of the suite, its file, the entry, its table for the task, and the flags."""
    (here / "mine.toml").write_text("env_kwargs = {a = 2, b = 2, c = 2, d = 2}")
    (here / "suite.toml").write_text(
        'envs = ["Pendulum-v1"]\nenv_kwargs = {e = 1, a = 1}\n[entries.td3]\n'
        'config = "mine.toml"\nenv_kwargs = {b = 3, c = 3, d = 3}\n'
        '[entries.td3.env."Pendulum-*"]\nenv_kwargs = {c = 4, d = 4}\n'
    )
    (job,) = expand(load("suite.toml"), {"env_kwargs": {"d": 5}}, "runs")
    assert job.config.run.env_kwargs == {"e": 1, "a": 2, "b": 3, "c": 4, "d": 5}
    one = resolve("td3", "Pendulum-v1", {"env_kwargs": {"a": 1, "b": 1}}, {"env_kwargs": {"b": 2}})
    assert one.run.env_kwargs == {"a": 1, "b": 2}
