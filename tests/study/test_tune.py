"""`tune`: studies go on where they were, workers share them, and no trial has a report's seed."""

import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time
import tomllib
from pathlib import Path
from typing import Any

import broken_envs
import jax
import pytest
from short_runs import TINY
from stopping import raiser

from pacesetter import algorithms
from pacesetter.cli.main import main
from pacesetter.cli.progress import console
from pacesetter.config import resolve
from pacesetter.errors import TrainingError, UsageError
from pacesetter.runs import RunDirectory, find, find_all
from pacesetter.settings.values import Tune
from pacesetter.study.bench.suite import TUNING_SEEDS, expand, of_algorithms
from pacesetter.study.tune import search as tune
from pacesetter.study.tune.journal import distribution, ranges, within
from pacesetter.study.tune.search import Tuning
from pacesetter.training.trainer import Trainer

optuna = pytest.importorskip("optuna")

PROBE = "broken_envs:Probe-v0"
# Its trials never come to an update, since compiling one takes longer than all else.
FIXED: dict[str, Any] = {**TINY, "steps": 400, "eval_every": 100, "warmup": 1_000}
FLAGS = [
    word
    for key, value in FIXED.items()
    for word in (
        f"--{key.replace('_', '-')}",
        *map(str, value if isinstance(value, tuple) else [value]),
    )
]


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Commands run in an empty folder, and theirs find this folder's tasks."""
    monkeypatch.chdir(tmp_path)
    path = [str(Path(broken_envs.__file__).parent), os.environ.get("PYTHONPATH", "")]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(path))
    return tmp_path


def silent(trainer: Trainer) -> Any:
    """Shows nothing of a trial."""
    return console(trainer, quiet=True)


def study(trials: int = 3, file: str = "study.log", **fixed: Any) -> Tuning:
    return Tuning("td3", PROBE, FIXED | fixed, trials, file)


def made(tuning: Tuning) -> list[Any]:
    """What is known of each trial: state, score, settings, intermediate scores."""
    return [
        (t.state.name, t.value, t.params, t.intermediate_values) for t in tuning.study.get_trials()
    ]


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> list[Any]:
    """Three trials that nobody stopped."""
    tuning = study(file=str(tmp_path_factory.mktemp("undisturbed") / "study.log"))
    tuning.run(silent)
    return made(tuning)


@pytest.mark.parametrize("name", algorithms.names())
def test_ranges(name: str) -> None:
    """Both ends of each are allowed, and each algorithm has some."""
    hyper = algorithms.find(name).Hyper
    found = ranges(hyper, {})
    assert found
    for key, one in found.items():
        for end in (one.low, one.high):
            assert getattr(resolve(name, "X-v0", {key: end}).hyper, key) == end
            assert distribution(one)._contains(end)
    assert key not in ranges(hyper, {key: 1})


def test_no_warmup_is_searched_in_which_the_budget_ends() -> None:
    found = ranges(algorithms.find("td3").Hyper, {})
    assert within(100_000, found) == found
    assert within(20_000, found)["warmup"] == Tune(1_000, 10_000, log=True)
    assert within(2_000, found) == {k: v for k, v in found.items() if k != "warmup"}
    assert within(100, {}) == {}


def test_a_study_that_would_never_learn_says_so(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["tune", "td3", PROBE, *FLAGS, "--trials", "1"]
    assert main([*words, "-q", "--study", "a.log"]) == 0
    assert "warm-up" not in capsys.readouterr().err
    assert main([*words, "--study", "b.log"]) == 0
    assert (
        "warmup: the run has 400 steps and acts at random for the first 1,000"
        in capsys.readouterr().err
    )


def test_what_td3_searches() -> None:
    """Nothing that changes the number of updates; DDPG's fixed settings are not searched."""
    searched = {"gamma", "normalize_observation", "batch_size", "warmup", "actor_learning_rate"}
    searched |= {"critic_learning_rate", "tau", "policy_delay", "target_noise"}
    searched |= {"exploration_noise", "critic_layer_norm", "actor_layer_norm", "normalize_reward"}
    assert set(ranges(algorithms.find("td3").Hyper, {})) == searched
    ddpg = set(ranges(algorithms.find("ddpg").Hyper, {}))
    assert ddpg == searched - {"policy_delay", "target_noise"}


def test_a_study(undisturbed: list[Any]) -> None:
    """It begins with the defaults; each trial reports every evaluation."""
    assert [state for state, *_ in undisturbed] == ["COMPLETE"] * 3
    first = undisturbed[0][2]
    usual = resolve("td3", PROBE, FIXED).settings()
    assert first == {key: usual[key] for key in first}
    assert first != undisturbed[1][2] != undisturbed[2][2]
    for _, value, _, reported in undisturbed:
        assert list(reported) == [1, 2, 3, 4]
        assert value == reported[4]


def test_score_is_the_mean_of_the_last_evaluations() -> None:
    rows = [{"kind": "eval", "step": 10 * i, "mean": float(i**2), "updates": i} for i in range(51)]
    rows.insert(3, {"kind": "train", "step": 5})
    assert tune._score(rows[:3]) == (1 + 4) / 2
    idle = [row | {"updates": 0} for row in rows[:2]]
    assert tune._score(idle) == 1  # of step 10; there is no other
    assert tune._score([*idle, *rows[2:4]]) == 4
    assert tune._score(rows[:12]) == (8**2 + 9**2 + 10**2) / 3
    assert tune._score(rows) == sum(i**2 for i in range(46, 51)) / 5


def test_best_is_what_train_takes(capsys: pytest.CaptureFixture[str]) -> None:
    """Its settings, and those that the study had fixed; its budget and seed are not."""
    words = ["tune", "td3", PROBE, *FLAGS, "--env.gain", "2", "--study", "a.log", "--trials", "2"]
    words += ["--warmup", "300"]  # these two do come to updates
    assert main([*words, "-q"]) == 0
    printed = capsys.readouterr()
    assert re.match(r"2 complete, 0 pruned, 0 failed; best [\d.]+ in trial (\d)\n", printed.out)
    assert "settings: a.best.toml" in printed.out
    assert re.fullmatch(
        r"(trial \d of 2: return [\d.]+, best [\d.]+ in trial \d\n){2}", printed.err
    )
    text = Path("a.best.toml").read_text()
    assert f"# pacesetter train td3 {PROBE} --config a.best.toml" in text
    table = tomllib.loads(text)
    assert "steps" not in table
    assert table["env_kwargs"] == {"gain": 2}
    best = Tuning(
        "td3", PROBE, FIXED | {"env_kwargs": {"gain": 2}, "warmup": 300}, 2, "a.log"
    ).study.best_trial
    flags = ["--config", "a.best.toml", "--steps", "200", "-q"]
    assert main(["train", "td3", PROBE, *flags]) == 0
    settings = find("td3/0").settings()
    assert {key: settings[key] for key in best.params} == best.params
    assert (settings["steps"], settings["seed"], settings["hidden"]) == (200, 0, [16, 16])


def test_the_command_of_the_best_settings_can_be_typed() -> None:
    """A file whose name has a space, and wrappers, which `train` takes from its own words alone."""
    tuning = study(1, file="my study.log", wrap=("odd_envs:Doubled",))
    tuning.run(silent)
    line, *_ = tuning.best_file.read_text().splitlines()
    words = ["train", "td3", PROBE, "--config", "my study.best.toml", "--wrap", "odd_envs:Doubled"]
    assert shlex.split(line) == ["#", "pacesetter", *words]
    assert main([*words, "--steps", "20", "-q"]) == 0


def test_values_of_the_best_settings_are_toml() -> None:
    given = {"a 🦿": [0.5, float("inf")], "b": {"c": True, "d": 1e-9}, "e": float("-inf")}
    assert tomllib.loads(f"x = {tune._toml(given)}")["x"] == given


def test_report_seeds_are_never_tuning_seeds() -> None:
    """Those of trials start where those that `bench` takes end."""
    tuning = study(trials=2)
    tuning.run(silent)
    seeds = {run.settings()["seed"] for run in find_all(tuning.runs)}
    assert seeds == {TUNING_SEEDS, TUNING_SEEDS + 1}
    suite = of_algorithms(["td3"])
    for seed in seeds:
        with pytest.raises(UsageError, match="seeds: must be from 0 to 2147483647"):
            expand(suite, {"envs": [PROBE], "seeds": [seed]}, "runs")
    assert expand(suite, {"envs": [PROBE], "seeds": [TUNING_SEEDS - 1]}, "runs")


def stop_after(tuning: Tuning, evaluations: int) -> None:
    """Let a worker save and end after so many evaluations."""
    score, left = tune._score, iter(range(evaluations - 1))

    def count(rows: Any) -> float:
        if next(left, None) is None:
            tuning.stop()
        return score(rows)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tune, "_score", count)
        tuning.run(silent)


@pytest.mark.slow
def test_stopped_study_goes_on(undisturbed: list[Any]) -> None:
    """The open trial from its checkpoint: all trials are those of a study left alone."""
    stopped = study()
    stop_after(stopped, 6)
    assert [state for state, *_ in made(stopped)] == ["COMPLETE", "RUNNING"]
    assert not stopped.over
    going_on = study()
    going_on.run(silent)
    assert going_on.over
    assert made(going_on) == undisturbed
    (resumed,) = [r for r in find_all(going_on.runs) if r.record().get("resumed")]
    assert resumed.settings()["name"] == "trial-1"


def claim(worker: Tuning) -> Any:
    found = worker._claim()
    assert found is not None
    return found


def test_trial_of_a_living_worker_is_left_alone() -> None:
    """One holds the lock of its trial, so another takes the next; when it is gone, that one."""
    first, second = study(), study()
    mine, lock = claim(first)
    yours, other = claim(second)
    assert (mine.number, yours.number) == (0, 1)
    lock.free()
    again, lock = claim(second)
    assert (again.number, again.params) == (0, mine.params)
    last, third = claim(first)
    assert last.number == 2
    assert first._claim() is None
    for held in (lock, other, third):
        held.free()


def test_what_a_killed_worker_left_stops_nobody(here: Path) -> None:
    """A lock of Optuna's own that leads nowhere, and a line of the journal that has no end."""
    tuning = study()
    (here / "study.log.lock").symlink_to("nowhere")
    with (here / "study.log").open("ab") as journal:
        journal.write(b'{"op_code":4,"worker')
    again = study()
    assert len(again.study.get_trials()) == len(tuning.study.get_trials())
    again.study.ask()
    for each in (tuning, study()):
        assert [trial.state.name for trial in each.study.get_trials()] == ["RUNNING"]


def test_a_study_that_is_a_pipe_is_refused(here: Path) -> None:
    os.mkfifo(here / "study.log")
    with pytest.raises(UsageError, match=r"study.log is not a study: not a file"):
        study()


def test_pruned_trial(capsys: pytest.CaptureFixture[str]) -> None:
    """It stops early and is never the best."""
    tuning = study(trials=2)
    tuning.study.pruner = optuna.pruners.ThresholdPruner(lower=1e9)
    tuning.run(silent)
    assert [state for state, *_ in made(tuning)] == ["PRUNED"] * 2
    assert all(list(reported) == [1] for *_, reported in made(tuning))
    assert not tuning.best_file.exists()
    assert tuning.summary() == "0 complete, 2 pruned, 0 failed"
    for run in find_all(tuning.runs):
        assert run.rows()[-1]["step"] == 100
        assert not run.state_file.parent.exists()


@pytest.mark.slow
def test_bad_trials_are_pruned_by_what_others_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    """With five good ones and a sixth that is worse from the start."""
    scores = iter([10.0] * 25)
    monkeypatch.setattr(tune, "_score", lambda rows: next(scores, -5.0))
    tuning = study(trials=6)
    tuning.run(silent)
    assert [state for state, *_ in made(tuning)] == ["COMPLETE"] * 5 + ["PRUNED"]


def test_failed_trial_counts_and_the_study_goes_on(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    tuning = study(trials=2)
    make = tuning._trainer_of

    def fail(trial: Any) -> Any:
        if trial.number == 0:
            raise TrainingError("member 0, step 3: a bolt fell out")
        return make(trial)

    monkeypatch.setattr(tuning, "_trainer_of", fail)
    tuning.run(silent)
    assert [state for state, *_ in made(tuning)] == ["FAIL", "COMPLETE"]
    assert "trial 0 of 2: failed: member 0, step 3: a bolt fell out\n" in capsys.readouterr().err
    assert tuning.summary().startswith("1 complete, 0 pruned, 1 failed; best")


def test_a_trial_without_memory_fails_and_keeps_no_replay(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Be it the machine's or the device's, which JAX tells by an error of its own."""
    tuning = study(trials=3)
    full: Any = iter([MemoryError(), jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: 9 bytes")])
    make = tuning._trainer_of

    def fail(trial: Any) -> Any:
        trainer = make(trial)
        if error := next(full, None):
            monkeypatch.setattr(trainer.loop, "tick", raiser(error))
        return trainer

    monkeypatch.setattr(tuning, "_trainer_of", fail)
    tuning.run(silent)
    assert [state for state, *_ in made(tuning)] == ["FAIL", "FAIL", "COMPLETE"]
    lines = capsys.readouterr().err
    assert "trial 0 of 3: failed: out of memory\n" in lines
    assert "trial 1 of 3: failed: the cpu is out of memory, lower --members" in lines
    assert len([*find_all(tuning.runs)]) == 3
    assert not any(run.state_file.parent.exists() for run in find_all(tuning.runs))


@pytest.mark.filterwarnings("error")
def test_the_rest_of_an_odd_budget_is_told_once() -> None:
    tuning = study(trials=1, steps=250)
    tuning.run(silent)
    ((_, _, _, reported),) = made(tuning)
    assert list(reported) == [1, 2]


def test_each_study_has_its_own_best_settings() -> None:
    names = ("sweep.1", "sweep.2", "sweep.log")
    best = [study(file=name).best_file.name for name in names]
    assert best == ["sweep.1.best.toml", "sweep.2.best.toml", "sweep.best.toml"]


def test_two_studies_do_not_share_their_best_settings() -> None:
    """`sweep` and `sweep.log` would both write sweep.best.toml."""
    study(file="sweep.log")
    with pytest.raises(UsageError, match=r"sweep.log has the same best.toml; give another --study"):
        study(file="sweep")
    study(file="other")
    with pytest.raises(UsageError, match="other has the same"):
        study(file="other.log")
    Path("mine").write_text("a script")
    Path("errors.log").touch()  # as a shell makes it for `2> errors.log`
    assert [study(file=name).file.name for name in ("mine.log", "errors")] == ["mine.log", "errors"]
    Path("sweep").write_bytes(Path("sweep.log").read_bytes())  # of an earlier version
    study(file="sweep")


@pytest.mark.parametrize("value", [None, [None], {"a": [1, None]}])
def test_a_keyword_that_toml_cannot_hold_is_refused_before_the_study(value: Any) -> None:
    with pytest.raises(UsageError, match="keyword of none"):
        study(env_kwargs={"k": value})


# Bad input.

BAD = {
    "--trials 0": ["trials", "0"],
    "--trials x": ["trials", "x"],
    "--seed 3": ["seed", "2147483648"],
    "--name x": ["name"],
    "--gama 1": ["--gama", "--gamma"],
    "--gamma 2": ["gamma", "2"],
    "--study .": ["study"],
    "--study text.log": ["study", "text.log"],
    "--study table.log": ["study", "table.log"],
}


@pytest.mark.parametrize("words", BAD)
def test_bad_flag(words: str, here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (here / "text.log").write_text("hello")
    (here / "table.log").write_text('{"a": 1}\n')
    before = {path: path.read_bytes() for path in here.iterdir()}
    assert main(["tune", "td3", PROBE, *words.split()]) == 2
    printed = capsys.readouterr()
    assert re.fullmatch(r"pacesetter: [^\n]+\n", printed.err), printed.err
    assert [word for word in BAD[words] if word not in printed.err] == [], printed.err
    assert {path: path.read_bytes() for path in here.iterdir()} == before


@pytest.mark.parametrize("env", ["NoSuch-v0", "broken_envs:DiscreteAction-v0"])
def test_bad_task(env: str, here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["tune", "td3", env]) == 2
    assert "env" in capsys.readouterr().err
    assert not list(here.iterdir())


def test_nothing_left_to_search() -> None:
    given = {name: getattr(resolve("td3", PROBE).hyper, name) for name in
             ranges(algorithms.find("td3").Hyper, {})}  # fmt: skip
    with pytest.raises(UsageError, match="no setting is left to search"):
        study(**given)


def test_settings_without_a_score_are_no_other_study() -> None:
    study()
    again = study(env_timeout="30s", checkpoint_every=9.0, device="cpu")
    assert again.config.run.env_timeout == 30
    with pytest.raises(UsageError, match=r"range of gamma=\[0.97, 0.999, False\], not None"):
        study(gamma=0.99)


def test_a_study_from_before_there_was_eval_policy_evaluated_the_champion() -> None:
    study()
    file, setting = Path("study.log"), '"eval_policy":"champion",'
    assert setting in file.read_text()
    file.write_text(file.read_text().replace(setting, ""))
    study()
    with pytest.raises(UsageError, match="eval_policy=champion, not ema"):
        study(eval_policy="ema")


def test_study_of_something_else_is_refused() -> None:
    study()
    for other, said in {("td3", "gamma"): "gamma", ("sac", "gamma"): "algorithm"}.items():
        with pytest.raises(UsageError, match=rf"study.log has .*{said}.*another --study"):
            Tuning(other[0], PROBE, FIXED | {other[1]: 0.5}, 3, "study.log")


# Processes.


def worker(*words: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "pacesetter", "tune", "td3", PROBE, *FLAGS, *words, "-q"]
    pipes: Any = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    return subprocess.Popen(command, text=True, **pipes)


@pytest.mark.slow
def test_trials_of_a_study_that_is_gone_are_not_taken_up(here: Path) -> None:
    """They have other settings, which a new study would train on with."""
    study(trials=1).run(silent)
    (here / "study.log").unlink()
    with pytest.raises(UsageError, match=r"^study: study.log is gone, but study.log.runs has"):
        study(trials=1, steps=300)
    assert not (here / "study.log").exists()
    study(trials=1, steps=300, file="other.log").run(silent)


def test_two_workers_one_of_which_is_killed(here: Path) -> None:
    """All trials are made, each once; the survivor takes up what the other left."""
    words = ("--trials", "4", "--steps", "1500", "--warmup", "1M", "--study", "s.log")
    both = [worker(*words), worker(*words)]
    victim, survivor = both
    end = time.monotonic() + 120
    while len(logs := list(here.rglob("metrics.jsonl"))) < 2 or not any(
        '"train"' in log.read_text() for log in logs
    ):
        assert [process.poll() for process in both] == [None, None], survivor.communicate()
        assert time.monotonic() < end
        time.sleep(0.01)
    victim.kill()
    victim.communicate()
    out, err = survivor.communicate(timeout=120)
    assert survivor.returncode == 0, err
    counts = re.match(r"(\d) complete, (\d) pruned, 0 failed; best", out)
    assert counts
    assert int(counts[1]) + int(counts[2]) == 4
    names = {run.settings()["name"] for run in find_all("s.log.runs")}
    assert names == {f"trial-{number}" for number in range(4)}
    # The victim had come to a trial's second half at most, and the survivor made the rest.
    done = re.findall(r"^trial (\d) of 4", err, re.MULTILINE)
    assert len(done) == len({*done}) >= 3
    assert json.loads(Path("s.log").read_text().splitlines()[0])["op_code"] == 0
    assert tomllib.loads(Path("s.best.toml").read_text())


@pytest.mark.slow
def test_interrupted_worker_saves(here: Path) -> None:
    words = ("--trials", "2", "--steps", "1M", "--eval-every", "1M", "--warmup", "1M")
    process = worker(*words)
    end = time.monotonic() + 120
    while not any('"train"' in log.read_text() for log in here.rglob("metrics.jsonl")):
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < end
        time.sleep(0.01)
    process.send_signal(signal.SIGTERM)
    out, _ = process.communicate(timeout=60)
    assert process.returncode == 143
    assert "saved; go on with `pacesetter tune td3" in out
    (run,) = find_all("tune.log.runs")
    assert not run.in_use()
    assert RunDirectory(run.path).rows()[-1]["step"] > 0


def test_a_study_whose_trials_all_failed_is_no_success(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(tuning: Tuning, trial: Any) -> Any:
        raise TrainingError("member 0, step 3: a bolt fell out")

    monkeypatch.setattr(Tuning, "_trainer_of", fail)
    words = ["tune", "td3", PROBE, "--trials", "2", "--steps", "300", "-q"]
    assert main(words) == 1
    assert "0 complete, 0 pruned, 2 failed" in capsys.readouterr().out
