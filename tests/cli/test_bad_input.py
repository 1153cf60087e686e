"""Bad input is met with one line that helps, exit code 2, and nothing on disk."""

import json
import os
import platform
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import broken_envs
import numpy as np
import pytest
import safetensors.numpy
from short_runs import TINY, assert_same, run_to_end, run_to_step

from pacesetter import storage
from pacesetter.cli.main import main
from pacesetter.errors import UsageError
from pacesetter.policy import Policy, load
from pacesetter.runs import RunDirectory
from pacesetter.training.trainer import Trainer

TASK = "HalfCheetah-v5"
# Few steps, so that input that should be refused and is not fails its test at once.
TRAIN = ["train", "td3", TASK, "--steps", "20", "--eval-episodes", "1"]
PROBE = "broken_envs:Probe-v0"

# What is typed after `train td3 HalfCheetah-v5`, and what the line must say.
BAD_FLAGS: dict[str, tuple[list[str], list[str]]] = {
    "unknown flag": (["--stepz", "5"], ["--stepz", "--steps"]),
    "unknown flag with =": (["--stepz=5"], ["--stepz", "--steps"]),
    "flag unlike any": (["--qzx"], ["--qzx", "pacesetter train td3", "--help"]),
    "sizes beyond any machine": (["--policy-delay", "10000000000000"], ["policy_delay", "1000"]),
    "abbreviated flag": (["--step", "5"], ["--step", "--steps"]),
    "flag of another algorithm": (["--critic-decay", "0.1"], ["--critic-decay"]),
    "flag without value": (["--steps"], ["--steps", "expected"]),
    "a word too many": (["really"], ["really"]),
    "no steps": (["--steps", "0"], ["steps", "1"]),
    "negative steps": (["--steps", "-5"], ["steps", "-5", "300k"]),
    "half a step": (["--steps", "1.5"], ["steps", "1.5", "whole"]),
    "steps in words": (["--steps", "many"], ["steps", "many", "300k"]),
    "steps with a wrong unit": (["--steps", "5g"], ["steps", "5g", "300k"]),
    "steps beyond all numbers": (["--steps", "1e999"], ["steps", "1e999"]),
    "time without a unit": (["--time", "2x"], ["time", "2x", "90s"]),
    "no time": (["--time", "0"], ["time", "greater than 0"]),
    "empty time": (["--time", ""], ["time", "90s"]),
    "checkpoint time": (["--checkpoint-every", "often"], ["checkpoint_every", "often", "90s"]),
    "negative seed": (["--seed", "-1"], ["seed", "0", "-1"]),
    "seed beyond 64 bits": (["--seed", str(2**64)], ["seed"]),
    "no members": (["--members", "0"], ["members", "1"]),
    "members in words": (["--members", "two"], ["members", "integer", "two"]),
    "too many members": (["--members", "2000"], ["members", "1000", "2000"]),
    "unknown rule": (["--rule", "bset"], ["rule", "bset", "best"]),
    "rule unlike any": (["--rule", "xyz"], ["rule", "xyz", "none", "tournament", "top_half"]),
    "unknown copy": (["--copy", "all"], ["copy", "all", "full", "weights", "actor"]),
    "unknown device": (["--device", "abacus"], ["device", "abacus", "cpu", "gpu"]),
    "absent device": (["--device", "tpu"], ["device", "tpu", "cpu"]),
    "name with a slash": (["--name", "a/b"], ["name", "a/b"]),
    "name that climbs": (["--name", ".."], ["name", ".."]),
    "name that is here": (["--name", "."], ["name"]),
    "empty name": (["--name", ""], ["name"]),
    "gamma above 1": (["--gamma", "1.5"], ["gamma", "1", "1.5"]),
    "gamma is NaN": (["--gamma", "nan"], ["gamma", "finite", "nan"]),
    "infinite rate": (["--actor-learning-rate", "inf"], ["actor_learning_rate", "finite", "inf"]),
    "no tau": (["--tau", "0"], ["tau", "greater than 0"]),
    "empty batch": (["--batch-size", "0"], ["batch_size", "1"]),
    "half a batch": (["--batch-size", "1.5"], ["batch_size", "integer", "1.5"]),
    "no layers": (["--hidden"], ["--hidden", "expected"]),
    "empty layer": (["--hidden", "0"], ["hidden", "0"]),
    "negative layer": (["--hidden", "16", "-16"], ["hidden", "-16"]),
    "layer in words": (["--hidden", "big"], ["hidden", "integer", "big"]),
    "unknown noise": (["--exploration", "pink"], ["exploration", "pink", "gaussian", "ou"]),
    "switch with a value": (["--wait", "maybe"], ["maybe"]),
    "unknown env keyword": (["--env.wings", "2"], ["env", TASK, "wings"]),
    "env keyword without value": (["--env.gain"], ["--env.gain", "value"]),
    "env keyword without name": (["--env.", "3"], ["--env.", "KEY"]),
    "unknown replay": (["--replay", "return-to-go"], ["replay", "return"]),
    "exponent of a uniform replay": (
        ["--replay-exponent", "0.6"],
        ["replay_exponent", "prioritized", "uniform"],
    ),
    "weights in LAP": (
        ["--replay", "lap", "--replay-importance", "0.4"],
        ["replay_importance", "prioritized", "lap"],
    ),
    "to go of errors": (
        ["--replay", "prioritized", "--replay-to-go"],
        ["replay_to_go", "return", "prioritized"],
    ),
    "horizon without a replay for it": (["--replay-horizon", "5k"], ["replay_horizon", "uniform"]),
    "horizon without weights": (
        ["--replay", "return", "--replay-horizon", "5k"],
        ["replay_horizon", "--replay-importance"],
    ),
    "horizon of weights that are off": (
        ["--replay", "prioritized", "--replay-importance", "0", "--replay-horizon", "5k"],
        ["replay_horizon", "--replay-importance"],
    ),
    "exponent beyond 2": (
        ["--replay", "lap", "--replay-exponent", "3"],
        ["replay_exponent", "less than or equal to 2", "3"],
    ),
    "no steps in a row": (["--n-step", "0"], ["n_step", "1", "0"]),
    "more rows than a replay takes": (
        ["--n-step", "100", "--members", "11"],
        ["n_step", "100", "11", "1000"],
    ),
    "trials that are off": (
        ["--members", "2", "--select-every", "10k"],
        ["select_every", "--select-on eval", "train"],
    ),
    "blocks longer than the run": (
        ["--update-every", "500", "--steps", "400"],
        ["update_every", "500", "at most 400"],
    ),
    "updates before what is assessed": (
        ["--assess", "2", "--warmup-updates"],
        ["warmup_updates", "--assess"],
    ),
    "assessments that are off": (["--assess-after", "5k"], ["assess_after", "--assess"]),
    "config that is not there": (["--config", "no.toml"], ["config", "no.toml"]),
}

# Whole commands.
BAD_COMMANDS: dict[str, tuple[list[str], list[str]]] = {
    "verb": (["trian", "td3", TASK], ["verb", "trian", "train"]),
    "verb unlike any": (["zzz"], ["verb", "zzz", "train", "resume", "eval", "list", "show"]),
    "no algorithm": (["train"], ["ALGO"]),
    "no env": (["train", "td3"], ["ENV", "--help"]),
    "algorithm": (["train", "tdd3", TASK], ["algorithm", "tdd3", "td3"]),
    "preset": (["train", "td3-papr", TASK], ["algorithm", "td3-papr", "td3-paper"]),
    "multi of multi": (["train", "multi-multi-td3", TASK], ["algorithm", "multi-td3"]),
    "settings first": (["train", "--seed", "1", "td3", TASK], ["ALGO", "ENV", "first"]),
    "settings between": (["train", "td3", "--seed", "1", TASK], ["ALGO", "ENV", "first"]),
    "algorithm's module": (["train", "no_such:Class", TASK], ["algorithm", "no_such"]),
    "algorithm's class": (["train", "json:Class", TASK], ["algorithm", "json:Class"]),
    "env": (["train", "td3", "HalfCheeta-v5"], ["env", "HalfCheeta-v5", TASK]),
    "unknown env, no version": (["train", "td3", "Zzz"], ["env", "'Zzz'", "module:Id-v0"]),
    "env of another package": (
        ["train", "td3", "FetchReach-v4"],
        ["pip install gymnasium-robotics", "gymnasium_robotics:FetchReach-v4"],
    ),
    "dm_control": (
        ["train", "td3", "dm_control/cheetah-run-v0"],
        ["pip install 'shimmy[dm-control]' 'mujoco<4'", "shimmy:dm_control/cheetah-run-v0"],
    ),
    "module of a known package": (
        ["train", "td3", "gymnasium_robotics:FetchReach-v4"],
        ["No module named", "`pip install gymnasium-robotics`"],
    ),
    "module that is not there": (
        ["train", "td3", "no_such_module:Task-v0"],
        ["no_such_module", "current one or in PYTHONPATH"],
    ),
    "versions in a module": (
        ["train", "td3", "odd_envs:OddInfo"],
        ["has no version", "write odd_envs:OddInfo-v0"],
    ),
    "reward that is not known": (
        ["train", "me-trpo", "Pendulum-v1", "--steps", "3000"],
        ["known", "Pendulum-v1", "Hopper-v4", "give --no-known"],
    ),
    "wrapper without a module": (
        ["train", "td3", PROBE, "--wrap", "Zzz"],
        ["wrap", "module:Class"],
    ),
    "wrapper that is not there": (
        ["train", "td3", PROBE, "--wrap", "odd_envs:Zzz"],
        ["wrap", "odd_envs:Zzz", "no attribute 'Zzz'"],
    ),
    "wrapper that fails": (
        ["train", "td3", PROBE, "--wrap", "odd_envs:MuteWrapper"],
        ["wrap", "odd_envs:MuteWrapper", "Mute"],
    ),
    "wrapper that is no env": (
        ["train", "td3", PROBE, "--wrap", "builtins:str"],
        ["wrap", "builtins:str", "must give an env, got a str"],
    ),
    "env of version 2": (["train", "td3", "Ant-v2"], ["env", "Ant-v2", "Ant-v5"]),
    "env of version 99": (["train", "td3", "Ant-v99"], ["env", "Ant-v99", "Ant-v5"]),
    "env's module": (["train", "td3", "no_such:X-v0"], ["env", "no_such:X-v0", "no_such"]),
    "id in a module": (["train", "td3", "json:Nope-v0"], ["env", "json:Nope-v0"]),
    "discrete actions": (["train", "td3", "CartPole-v1"], ["action space", "Box", "Discrete"]),
    "fixed critics": (
        ["train", "ddpg", TASK, "--critics", "2"],
        ["critics", "2", "allowed: 1"],
    ),
    "fixed noise": (
        ["train", "ddpg", TASK, "--target-noise", "0.1"],
        ["target_noise", "0.1", "allowed: 0"],
    ),
    "parameter noise without layer norm": (
        ["train", "td3", TASK, "--exploration", "parameter"],
        ["exploration", "parameter", "--actor-layer-norm"],
    ),
    "noise on a stochastic policy": (
        ["train", "sac", TASK, "--exploration", "ou"],
        ["exploration", "ou", "stochastic", "allowed: policy"],
    ),
    "unknown exploration of sac": (
        ["train", "crossq", TASK, "--exploration", "pink"],
        ["exploration", "pink", "allowed: policy"],
    ),
    "quantiles below none": (
        ["train", "sac", TASK, "--quantiles", "-1"],
        ["quantiles", "greater than or equal to 0", "-1"],
    ),
    "targets of crossq": (["train", "crossq", TASK, "--tau", "0.01"], ["flag", "--tau"]),
    "resume nothing": (["resume"], ["RUN"]),
    "resume of a missing run": (["resume", "Ant-v5/td3/0"], ["Ant-v5/td3/0", "not found"]),
    "resume elsewhere": (["resume", "x", "--runs", "there"], ["'x'", "not found", "there"]),
    "show of a missing run": (["show", "nothing"], ["nothing", "not found"]),
    "eval of a missing run": (["eval", "nothing"], ["nothing", "not found"]),
    "eval of a missing file": (["eval", "no.safetensors"], ["no.safetensors", "no such file"]),
    "list of what": (["list", "algoritms"], ["algoritms", "algorithms"]),
    "list of what there is not": (["list", "seeds"], ["'seeds'", "algorithms", "envs"]),
}

# Settings files, as text, and what the line must say.
BAD_CONFIGS: dict[str, tuple[str, list[str]]] = {
    "unknown key": ("batch_sise = 3", ["batch_sise", "batch_size"]),
    "key unlike any": ("wheels = 3", ["wheels"]),
    "value out of range": ("gamma = 2", ["gamma", "2"]),
    "value of a wrong type": ('batch_size = "many"', ["batch_size", "many"]),
    "true for a whole number": ("members = true", ["members", "number", "true"]),
    "true for a number": ("gamma = true", ["gamma", "number", "true"]),
    "list for a number": ("seed = [1, 2]", ["seed", "[1, 2]"]),
    "bad count": ('eval_every = "1x"', ["eval_every", "1x"]),
    "infinite number": ("tau = inf", ["tau", "finite"]),
    "no TOML": ("steps = = 3", ["config", "file.toml"]),
    "not text": ("\udcff\udcfe", ["config", "file.toml"]),
    "settings not a table": ("settings = 3", ["config", "file.toml"]),
    "folder that climbs": ('name = "../../elsewhere"', ["name", "elsewhere"]),
}

# Tasks of broken_envs.py and what the line must say.
BAD_TASKS = {
    "WrongShape": ["observation", "(3,)", "(4,)"],
    "NanObservation": ["observation", "finite", "number 1", "nan"],
    "NanReset": ["observation", "finite", "nan"],
    "TextObservation": ["observation", "numbers"],
    "HugeReward": ["reward", "finite and at most", "1e+39"],
    "InfiniteReward": ["reward", "finite", "inf"],
    "ArrayReward": ["reward", "one number"],
    "NoReward": ["reward", "one number", "None"],
    "FourValues": ["step", "truncated"],
    "BareReset": ["reset", "(observation, info)"],
    "RaisesInStep": ["the motor is on fire"],
    "RaisesInReset": ["no ground to stand on"],
    "RaisesWhenMade": ["OSError: no licence file see the manual"],
    "MuteWhenMade": ["cannot make", "Mute"],
    "BareAssert": ["reset", "AssertionError in odd_envs.py, line", 'assert "ground" in words'],
    "MuteReward": ["reward", "one number", "a Mute that cannot be printed"],
    "TwoInTerminated": ["terminated", "True or False", "2"],
    "ListInfo": ["info", "must be a dict", "{} will do"],
    "LateDict": ["step", "KeyError: 'speed'"],
    "DiscreteObservation": ["observation space", "Box", "Discrete", "--wrap module:Class"],
    "Image": ["observation space", "image of 8x8x3 uint8", "train on numbers", "--wrap"],
    "DictOfImage": ["observation space", "image of 8x8x3 uint8"],
    "MuteSpace": ["observation space", "failed: Mute"],
    "WordBounds": ["observation space", "bounds must be numbers of its shape (3,)"],
    "NoBounds": ["action space", "bounds must be numbers of its shape (2,)"],
    "NarrowBounds": ["action space", "number 1 has no float32 number between its bounds"],
    "DiscreteAction": ["action space", "Box", "Discrete"],
    "DictAction": ["action space", "Box", "Dict"],
    "InfiniteBounds": ["action space", "finite", "inf"],
    "IntegerAction": ["action space", "float32", "int32"],
    "NoNumbers": ["observation space", "at least one", "(0,)"],
    "NoActions": ["action space", "at least one", "(0,)"],
    "NoSpaces": ["observation space", "Box", "NoneType"],
}

Refused = Callable[..., str]


def tree(folder: Path) -> dict[str, bytes]:
    """All files below a folder; a lock's content is nobody's business."""
    files = [path for path in folder.rglob("*") if path.is_file() and path.name != "lock"]
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Commands run in an empty folder, where `runs` would appear."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def refused(capsys: pytest.CaptureFixture[str], here: Path) -> Refused:
    """Run a command that must be refused with one line and leave every file as it is."""

    def run(*words: object, code: int = 2) -> str:
        before = tree(here)
        assert main([str(word) for word in words]) == code
        printed = capsys.readouterr()
        assert printed.out == ""
        assert re.fullmatch(r"pacesetter: [^\n]+\n", printed.err), printed.err
        assert len(printed.err) < 600
        assert tree(here) == before
        return printed.err

    return run


def says(line: str, words: list[str]) -> None:
    """The line has every word."""
    assert not [word for word in words if word not in line], line


@pytest.mark.parametrize("case", BAD_FLAGS)
def test_bad_flag(case: str, refused: Refused) -> None:
    words, expected = BAD_FLAGS[case]
    says(refused(*TRAIN, *words), expected)
    assert not Path("runs").exists()


@pytest.mark.parametrize("case", BAD_COMMANDS)
def test_bad_command(case: str, refused: Refused) -> None:
    words, expected = BAD_COMMANDS[case]
    says(refused(*words), expected)
    assert not Path("runs").exists()


@pytest.mark.parametrize("case", BAD_CONFIGS)
def test_bad_config(case: str, refused: Refused, here: Path) -> None:
    text, expected = BAD_CONFIGS[case]
    (here / "file.toml").write_bytes(text.encode(errors="surrogateescape"))
    says(refused(*TRAIN, "--config", "file.toml"), expected)
    assert not Path("runs").exists()


@pytest.mark.parametrize("text", ["[1, 2]", "3", "{", '{"settings": [1]}', '{"gama": 1}'])
def test_bad_json_config(text: str, refused: Refused, here: Path) -> None:
    (here / "file.json").write_text(text)
    says(refused(*TRAIN, "--config", "file.json"), ["gam" if "gama" in text else "file.json"])
    assert not Path("runs").exists()


def test_config_that_is_a_folder(refused: Refused, here: Path) -> None:
    (here / "file.toml").mkdir()
    says(refused(*TRAIN, "--config", "file.toml"), ["config", "file.toml"])


@pytest.mark.parametrize("name", BAD_TASKS)
def test_broken_task(name: str, refused: Refused) -> None:
    module = "broken_envs" if hasattr(broken_envs, name) else "odd_envs"
    says(refused("train", "td3", f"{module}:{name}-v0"), [name, *BAD_TASKS[name]])
    assert not Path("runs").exists()


def test_every_broken_task_differs_from_one_that_trains(whole: RunDirectory) -> None:
    """The refusals above are for the fault, not for something that all these tasks share."""
    assert [row["lengths"] for row in whole.rows() if row["kind"] == "eval"] == [[100]] * 5


def test_env_that_fails_to_close(capsys: pytest.CaptureFixture[str]) -> None:
    """All is done and saved by then; the fault is told in one line all the same."""
    words = [*TRAIN[:2], "broken_envs:RaisesInClose-v0", "--steps", "20", "--eval-episodes", "1"]
    assert main(words) == 1
    *_, line = capsys.readouterr().err.splitlines()
    says(line, ["RaisesInClose", "close", "the door is stuck"])


def test_folder_of_the_user_stays(refused: Refused, here: Path) -> None:
    """A run that cannot start removes what it made and no more."""
    huge = ["--replay-size", "1e13", "--steps", "1e13"]
    (here / "mine").mkdir()
    for runs in ("mine", ".", "new/deep"):
        says(refused(*TRAIN, *huge, "--runs", runs), ["replay"])
        assert [path.name for path in here.iterdir()] == ["mine"]


def test_keywords_that_no_file_can_hold(here: Path) -> None:
    with pytest.raises(UsageError, match=r"env_kwargs: must be plain .* float32"):
        Trainer("td3", PROBE, env_kwargs={"gain": np.float32(2)})
    assert not [*here.iterdir()]


def test_unwritable_runs_folder(refused: Refused, here: Path) -> None:
    (here / "file").write_text("not a folder")
    says(refused(*TRAIN, "--runs", "file"), ["runs", "file"])


# An existing run.


@pytest.fixture(scope="module")
def halfway(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that was stopped at steps 300 and 500 of 700, so with two checkpoints."""
    settings = {**TINY, "steps": 700, "eval_every": 200}
    trainer = Trainer("td3", PROBE, runs=tmp_path_factory.mktemp("halfway") / "runs", **settings)
    for step in (300, 500):
        run_to_step(trainer, step)
        trainer = Trainer.resume(trainer.directory.path)
    trainer.close()
    return trainer.directory.path


@pytest.fixture
def run(halfway: Path, here: Path) -> RunDirectory:
    """A copy of that run below `runs`."""
    path = here / "runs" / "broken_envs-Probe-v0" / "td3" / "0"
    shutil.copytree(halfway, path)
    return RunDirectory(path)


@pytest.fixture(scope="module")
def whole(halfway: Path, tmp_path_factory: pytest.TempPathFactory) -> RunDirectory:
    """The same run without a stop."""
    settings = {**TINY, "steps": 700, "eval_every": 200}
    return run_to_end(Trainer("td3", PROBE, runs=tmp_path_factory.mktemp("whole"), **settings))


@pytest.fixture
def same(run: RunDirectory) -> Path:
    """The settings of that run in a file."""
    settings: dict[str, Any] = {**TINY, "steps": 700, "eval_every": 200}
    lines = [f"{k} = {list(v) if isinstance(v, tuple) else v}" for k, v in settings.items()]
    config = run.path.parent / "same.toml"
    config.write_text("\n".join(lines))
    return config


def test_train_onto_a_run(run: RunDirectory, same: Path, refused: Refused) -> None:
    """The line says how to go on, and which setting differs if one does."""
    again = ["train", "td3", PROBE, "--config", same]
    says(refused(*again), [str(run.path.name), "exists", "pacesetter resume runs/"])
    line = refused(*again, "--gamma", "0.5")
    says(line, ["gamma=0.99", "0.5", "--name", "pacesetter resume runs/"])
    says(refused(*again, "--env.gain", "2"), ["env_kwargs", "gain", "--name"])


def test_train_beside_seeds_of_other_settings(same: Path, refused: Refused) -> None:
    """Seeds of one name differ in their budget at most; whoever compares them relies on it."""
    again = ["train", "td3", PROBE, "--seed", "1", "--config", same]
    says(refused(*again, "--gamma", "0.5"), ["td3/0", "gamma=0.99", "0.5", "--name"])
    says(refused(*again, "--env.gain", "2"), ["td3/0", "env_kwargs", "--name"])
    assert main([str(word) for word in [*again, "--steps", "300"]]) == 0


def test_ambiguous_run(run: RunDirectory, refused: Refused, here: Path) -> None:
    other = here / "runs" / "broken_envs-Probe-v0" / "other" / "0"
    shutil.copytree(run.path, other)
    for verb in ("resume", "eval", "show"):
        line = refused(verb, "0")
        says(line, ["'0'", "td3/0", "other/0"])


def test_missing_run_names_those_there_are(run: RunDirectory, refused: Refused) -> None:
    says(refused("resume", "1"), ["'1'", "not found", str(Path(*run.path.parts[-4:]))])


BAD_RESUMES: dict[str, tuple[list[str], list[str]]] = {
    "count": (["--steps", "1.5"], ["steps", "1.5", "whole"]),
    "time": (["--time", "later"], ["time", "later", "90s"]),
    "flag": (["--gamma", "0.9"], ["--gamma"]),
}


@pytest.mark.parametrize("case", BAD_RESUMES)
def test_bad_flag_of_resume(case: str, run: RunDirectory, refused: Refused) -> None:
    words, expected = BAD_RESUMES[case]
    says(refused("resume", run.path, *words), expected)
    assert not run.in_use()


BAD_EVALS: dict[str, tuple[list[str], list[str]]] = {
    "no episodes": (["--episodes", "0"], ["episodes", "1", "0"]),
    "episodes in words": (["--episodes", "ten"], ["episodes", "ten"]),
    "negative seed": (["--seed", "-1"], ["seed", "-1"]),
    "negative noise": (["--noise", "-0.1"], ["noise", "-0.1"]),
    "noise of random actions": (["--noise", "0.1", "--random"], ["noise", "--random"]),
    "noise is NaN": (["--noise", "nan"], ["noise", "nan"]),
    "another task's sizes": (["--env", "Ant-v5"], ["Ant-v5", "105", "8", "3", "2"]),
    "unknown task": (["--env", "Antt-v5"], ["env", "Antt-v5", "Ant-v5"]),
}


@pytest.mark.parametrize("case", BAD_EVALS)
def test_bad_flag_of_eval(case: str, run: RunDirectory, refused: Refused) -> None:
    words, expected = BAD_EVALS[case]
    says(refused("eval", run.path, *words), expected)


# Damage.


def cut(path: Path, share: float = 0.5) -> None:
    """Cut a file off."""
    os.truncate(path, int(path.stat().st_size * share))


def flip(path: Path, place: int = -40, bit: int = 3) -> None:
    """Turn one bit of a file over."""
    data = bytearray(path.read_bytes())
    data[place] ^= 1 << bit
    path.write_bytes(data)


def clear(path: Path) -> None:
    """Leave a file with nothing in it."""
    path.write_bytes(b"")


def fill(path: Path) -> None:
    """Random bytes for a file's own."""
    path.write_bytes(np.random.default_rng(3).bytes(path.stat().st_size))


DAMAGES = (cut, flip, clear, fill, Path.unlink)
Damage = Callable[..., None]


@pytest.mark.parametrize("damage", [cut, flip, Path.unlink])
def test_damaged_newest_checkpoint(
    damage: Damage, run: RunDirectory, whole: RunDirectory, capsys: pytest.CaptureFixture[str]
) -> None:
    """The one before it is taken, a note says so, and the run ends as if nothing had been."""
    damage(run.state_file)
    assert main(["resume", str(run.path), "-q"]) == 0
    note = capsys.readouterr().err
    assert note.count("\n") == (0 if damage is Path.unlink else 1)
    if note:
        says(note, ["pacesetter: ", "state.safetensors", "checkpoint before"])
    assert_same(whole, run)


@pytest.mark.parametrize("damage", DAMAGES[:-1])
def test_both_checkpoints_damaged(damage: Damage, run: RunDirectory, refused: Refused) -> None:
    damage(run.state_file)
    damage(run.previous_file)
    says(refused("resume", run.path), ["state.safetensors", "no whole checkpoint"])
    assert not run.in_use()


def test_kill_after_falling_back(
    run: RunDirectory, whole: RunDirectory, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A kill in the first save after a fall-back leaves the good checkpoint, not the damaged."""
    flip(run.state_file)
    trainer = Trainer.resume(run.path)
    replace = Path.replace

    def killed(path: Path, target: Path) -> Path:
        if path.name.startswith("state."):
            raise SystemExit("killed")
        return replace(path, target)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", killed)
        with pytest.raises(SystemExit):
            run_to_end(trainer)
    assert_same(whole, run_to_end(Trainer.resume(run.path)))


def test_checkpoint_of_another_run(run: RunDirectory, refused: Refused) -> None:
    """Sizes that differ are named, not loaded."""
    arrays, table = storage.read(run.state_file, "checkpoint")
    arrays["states.0.actor.0.bias"] = arrays["states.0.actor.0.bias"][:8]
    storage.write(run.state_file, "checkpoint", storage.Content(arrays, table))
    run.previous_file.unlink()
    words = ["state.safetensors", "does not fit", "actor.0.bias", "(8,)", "(16,)"]
    says(refused("resume", run.path), words)


def test_policy_for_a_checkpoint(run: RunDirectory, refused: Refused) -> None:
    for file in (run.state_file, run.previous_file):
        shutil.copy(run.policy_file, file)
    says(refused("resume", run.path), ["state.safetensors", "not a pacesetter checkpoint"])


@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_replay(
    damage: Damage, run: RunDirectory, capsys: pytest.CaptureFixture[str]
) -> None:
    """Rows that both checkpoints need are checked, and missed."""
    file = run.path / "last" / "replay-0.bin"
    places = {cut: {"share": 0.1}, flip: {"place": 400}}
    damage(file, **places.get(damage, {}))
    assert main(["resume", str(run.path)]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    says(error, ["replay-0.bin", "damaged"])
    assert not run.in_use()


def test_damaged_new_rows_of_replay(
    run: RunDirectory, whole: RunDirectory, capsys: pytest.CaptureFixture[str]
) -> None:
    """Rows that only the newest checkpoint needs cost only that checkpoint."""
    width = (3 + 2 + 3 + 3) * 4
    flip(run.path / "last" / "replay-0.bin", place=400 * width)
    assert main(["resume", str(run.path), "-q"]) == 0
    says(capsys.readouterr().err, ["replay-0.bin", "checkpoint before"])
    assert_same(whole, run)


def test_shortened_log(run: RunDirectory, capsys: pytest.CaptureFixture[str]) -> None:
    """What is lost is said, and training goes on: the log decides nothing."""
    rows = run.rows()
    clear(run.metrics_file)
    assert main(["resume", str(run.path), "-q"]) == 0
    says(capsys.readouterr().err, ["metrics.jsonl", "missing"])
    assert run.rows()[-1]["step"] == 700 > rows[-1]["step"]


def test_foreign_log(run: RunDirectory, refused: Refused) -> None:
    run.metrics_file.write_text("step,return\n0,1\n")
    says(refused("show", run.path), ["metrics.jsonl", "damaged"])
    fill(run.metrics_file)
    says(refused("show", run.path), ["metrics.jsonl", "damaged"])


def test_log_whose_lines_are_no_rows(run: RunDirectory, refused: Refused) -> None:
    run.metrics_file.write_text("3\n")
    says(refused("show", run.path), ["metrics.jsonl", "damaged"])
    run.metrics_file.write_text('{"kind": "eval"}\n')
    says(refused("show", run.path), [str(run.path), "damaged"])


def test_list_goes_on_after_a_damaged_run(
    run: RunDirectory, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A config without steps spoils its own line only."""
    shutil.copytree(run.path, copy := run.path.with_name("7"))
    table = json.loads(run.config_file.read_text())
    del table["settings"]["steps"]
    run.config_file.write_text(json.dumps(table))
    capsys.readouterr()
    assert main(["list", "runs", "--runs", str(run.path.parents[2])]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert any(str(run.path) in line and "settings.steps is missing" in line for line in lines)
    assert any(str(copy) in line and "of 700" in line for line in lines)


def test_names_of_folders_reach_no_terminal_raw(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "\x1b[31mred" / "x" / "0"
    folder.mkdir(parents=True)
    (folder / "config.json").write_text("{}")
    for words in (["list"], ["list", "runs"]):
        assert main([*words, "--runs", str(tmp_path)]) == 0
        shown = capsys.readouterr().out
        assert "\x1b" not in shown
        assert "31mred/x/0" in shown  # as one word, to copy


def change(**settings: Any) -> Callable[[dict[str, Any]], object]:
    """Settings of config.json to these."""
    return lambda table: table["settings"].update(settings)


BAD_RECORDS: dict[str, tuple[Callable[[dict[str, Any]], object], list[str]]] = {
    "other schema": (lambda t: t.update(schema=99), ["config.json", "99", "1"]),
    "no schema": (lambda t: t.pop("schema"), ["config.json", "schema"]),
    "no settings": (lambda t: t.pop("settings"), ["config.json", "settings"]),
    "settings a list": (lambda t: t.update(settings=[1]), ["config.json"]),
    "no algorithm": (lambda t: t["settings"].pop("algorithm"), ["config.json", "algorithm"]),
    "no env": (lambda t: t["settings"].pop("env"), ["config.json", "env"]),
    "algorithm a number": (change(algorithm=3), ["algorithm"]),
    "env a list": (change(env=["Ant-v5"]), ["env"]),
    "unknown algorithm": (change(algorithm="td4"), ["algorithm", "td4", "td3"]),
    "unknown setting": (change(gama=1), ["gama", "gamma"]),
    "bad value": (change(steps="x"), ["steps", "x"]),
    "bad layers": (change(hidden=[]), ["hidden"]),
    "threads in words": (lambda t: t.update(threads="x"), ["config.json", "threads"]),
}


@pytest.mark.parametrize("case", BAD_RECORDS)
def test_damaged_config(
    case: str, run: RunDirectory, refused: Refused, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NPROC", os.environ.get("NPROC", "1"))  # so that it is put back
    edit, expected = BAD_RECORDS[case]
    table = json.loads(run.config_file.read_text())
    edit(table)
    run.config_file.write_text(json.dumps(table))
    says(refused("resume", run.path), expected)


@pytest.mark.parametrize("text", ["", "{", "[1]", "3", "null", '{"schema": 1}', "[" * 100_000])
def test_config_that_is_none(text: str, run: RunDirectory, refused: Refused) -> None:
    run.config_file.write_text(text)
    for verb in ("resume", "show"):
        says(refused(verb, run.path), ["config.json", "damaged"])


@pytest.mark.parametrize("damage", [cut, fill])
def test_config_in_pieces(damage: Damage, run: RunDirectory, refused: Refused) -> None:
    damage(run.config_file)
    for verb in ("resume", "show"):
        says(refused(verb, run.path), ["config.json", "damaged"])


# A second process.

HOLD = """
import sys
from pathlib import Path
from pacesetter.runs import RunDirectory
directory = RunDirectory(Path(sys.argv[1]))
directory.lock()
print("held", flush=True)
sys.stdin.read()
"""


def test_run_in_use(run: RunDirectory, refused: Refused, whole: RunDirectory) -> None:
    """Whoever holds the run is named; when it is dead, killed even, the run is free."""
    command = [sys.executable, "-c", HOLD, str(run.path)]
    pipes: Any = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen(command, **pipes, text=True) as holder:
        try:
            assert holder.stdout is not None
            assert holder.stdout.readline() == "held\n"
            assert run.in_use()
            before = tree(run.path)
            says(refused("resume", run.path, code=75), ["in use", str(holder.pid), platform.node()])
            assert tree(run.path) == before
        finally:
            holder.kill()
    assert not run.in_use()
    assert main(["resume", str(run.path), "-q"]) == 0
    assert_same(whole, run)


def test_new_run_in_use(refused: Refused, here: Path) -> None:
    """Two that start the same run at once: the second is refused before it writes a setting."""
    path = here / "runs" / TASK / "td3" / "0"
    path.mkdir(parents=True)
    first = RunDirectory(path)
    first.lock()
    try:
        says(refused(*TRAIN, code=75), ["in use", str(os.getpid()), platform.node()])
    finally:
        first.unlock()


# Policy files of strangers.


def make_policy(env: str = TASK, inputs: int = 17, outputs: int = 6) -> Policy:
    """A small policy with random weights."""
    rng = np.random.default_rng(5)
    sizes = [(inputs, 8), (8, outputs)]
    layers = [
        {
            "kernel": rng.normal(size=size).astype(np.float32),
            "bias": rng.normal(size=size[1]).astype(np.float32),
        }
        for size in sizes
    ]
    bound = np.ones(outputs, np.float32)
    about = {"env": env, "env_kwargs": {}, "step": 3}
    return Policy([layers], "relu", "tanh", -bound, bound, about=about)


@pytest.fixture
def file(here: Path) -> Path:
    """A policy file that is whole."""
    path = here / "policy.safetensors"
    make_policy().save(path)
    return path


def test_whole_policy_file_is_taken(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """What the tests below damage is fine as it is."""
    assert main(["eval", str(file), "--episodes", "1"]) == 0
    assert "over 1 episode of" in capsys.readouterr().out


def damaged(file: Path, data: bytes) -> None:
    """A file with this content is refused in one line that names it."""
    file.write_bytes(data)
    with pytest.raises(UsageError, match=re.escape(str(file))) as refusal:
        load(file)
    assert "\n" not in str(refusal.value)


def test_truncated_policy(file: Path, refused: Refused) -> None:
    """At every length from nothing to one byte short of all."""
    data = file.read_bytes()
    for size in range(0, len(data), 7):
        damaged(file, data[:size])
    for size in (0, 5, 8, 100, len(data) // 2, len(data) - 1):
        file.write_bytes(data[:size])
        says(refused("eval", file), [str(file)])


def test_flipped_bits_of_policy(file: Path, refused: Refused) -> None:
    """Any bit, of header, hashes or weights."""
    data, rng = file.read_bytes(), np.random.default_rng(11)
    header = 8 + int.from_bytes(data[:8], "little")
    places = [*range(8), *rng.integers(8, header, 500), *rng.integers(header, len(data), 500)]
    for count, place in enumerate(places):
        changed = bytearray(data)
        changed[place] ^= 1 << int(rng.integers(8))
        damaged(file, bytes(changed))
        if count % 50 == 0:
            says(refused("eval", file), [str(file)])


def test_overwritten_stretches_of_policy(file: Path) -> None:
    """Random bytes, zeros or another part of the same file over a stretch of it."""
    data, rng = file.read_bytes(), np.random.default_rng(12)
    for _ in range(300):
        size = int(rng.integers(1, 200))
        start, other = rng.integers(len(data) - size, size=2)
        stretch = [rng.bytes(size), bytes(size), data[other : other + size]][rng.integers(3)]
        if data[start : start + size] != stretch:
            damaged(file, data[:start] + stretch + data[start + size :])


def test_something_else_for_a_policy(file: Path, refused: Refused, run: RunDirectory) -> None:
    """Random bytes, other people's files, a checkpoint, a folder."""
    weights = {"weight": np.ones((3, 3), np.float32)}
    others = {
        "noise": np.random.default_rng(1).bytes(5_000),
        "text": b"this is no safetensors file, though it has the name of one",
        "zip": b"PK\x03\x04" + bytes(500),
        "long header": (2**60).to_bytes(8, "little") + b"{}" * 100,
        "deep header": len(b"[" * 90_000).to_bytes(8, "little") + b"[" * 90_000,
        "list header": (4).to_bytes(8, "little") + b"[{}]",
        "foreign": safetensors.numpy.save(weights),
        "foreign with metadata": safetensors.numpy.save(weights, metadata={"format": "pt"}),
        "says policy": safetensors.numpy.save(weights, metadata={"kind": "policy"}),
        "checkpoint": run.state_file.read_bytes(),
    }
    for data in others.values():
        file.write_bytes(data)
        says(refused("eval", file), [str(file)])
    file.unlink()
    file.mkdir()
    says(refused("eval", file), [str(file)])


def _without(name: str) -> Callable[[Any, Any], object]:
    return lambda arrays, table: arrays.pop(name)


def _array(name: str, value: Any) -> Callable[[Any, Any], object]:
    return lambda arrays, table: arrays.update({name: np.asarray(value)})


def _entry(**values: Any) -> Callable[[Any, Any], object]:
    return lambda arrays, table: table.update(values)


NAN = np.full((17, 8), np.nan, np.float32)
# Files that are whole, hashes and all, but hold what no policy is.
CRAFTED: dict[str, Callable[[Any, Any], object]] = {
    "no bounds": _without("low"),
    "no kernel": _without("actors.0.0.kernel"),
    "no bias": _without("actors.0.1.bias"),
    "no layer": lambda a, t: [a.pop(f"actors.0.0.{part}") for part in ("kernel", "bias")],
    "no actors": lambda a, t: [a.pop(name) for name in list(a) if name.startswith("actors")],
    "NaN": _array("actors.0.0.kernel", NAN),
    "flat kernel": _array("actors.0.0.kernel", np.ones(17, np.float32)),
    "layers that do not join": _array("actors.0.1.kernel", np.ones((9, 6), np.float32)),
    "wrong bounds": _array("low", np.ones(5, np.float32)),
    "bounds of another size above": _array("high", np.ones(5, np.float32)),
    "NaN bounds": _array("high", np.full(6, np.nan, np.float32)),
    "mean without deviation": _array("mean", np.ones(17, np.float32)),
    "enormous and empty": _array("actors.0.0.kernel", np.zeros((10**13, 0), np.float32)),
    "odd name": _array("actors.x.0.kernel", np.ones(3, np.float32)),
    "short name": _array("actors.0", np.ones(3, np.float32)),
    "gap in layers": _array("actors.0.7.kernel", np.ones((8, 8), np.float32)),
    "unknown activation": _entry(activation="eval"),
    "activation a list": _entry(activation=["relu"]),
    "unknown output": _entry(output="softmax"),
    "other schema": _entry(schema=2),
    "about nothing": _entry(about=None),
    "no env": _entry(about={}),
    "env a number": _entry(about={"env": 3}),
    "env unknown": _entry(about={"env": "Nope-v0"}),
    "keywords a list": _entry(about={"env": TASK, "env_kwargs": [1]}),
    "keywords unknown": _entry(about={"env": TASK, "env_kwargs": {"wings": 2}}),
    "step in words": _entry(about={"env": TASK, "step": "x"}),
}


@pytest.mark.parametrize("case", CRAFTED)
def test_crafted_policy(case: str, file: Path, refused: Refused) -> None:
    arrays, table = storage.read(file, "policy")
    CRAFTED[case](arrays, table)
    storage.write(file, "policy", storage.Content(arrays, table))
    refused("eval", file, "--episodes", "1")


def test_crafted_table(file: Path, refused: Refused) -> None:
    arrays, _ = storage.read(file, "policy")
    for table in ([], 3, None, "policy"):
        storage.write(file, "policy", storage.Content(arrays, table))  # type: ignore[arg-type]
        says(refused("eval", file), [str(file)])


INTRUDER = """
from pathlib import Path
import gymnasium
Path("intruded").touch()
entry = "gymnasium.envs.mujoco.half_cheetah_v5:HalfCheetahEnv"
gymnasium.register("Intruder-v0", entry_point=entry, max_episode_steps=20)
"""


def test_policy_file_imports_no_module(
    file: Path, refused: Refused, here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A file that names `module:Id-v0` has that module imported only if a person says so."""
    (here / "intruder.py").write_text(INTRUDER)
    monkeypatch.syspath_prepend(here)
    make_policy("intruder:Intruder-v0").save(file)
    says(refused("eval", file), ["intruder:Intruder-v0", "--allow intruder:Intruder-v0"])
    assert not (here / "intruded").exists()
    assert "intruder" not in sys.modules
    assert main(["eval", str(file), "--env", "intruder:Intruder-v0", "--episodes", "1"]) == 0
    assert (here / "intruded").exists()
    del sys.modules["intruder"]


def test_whole_process_prints_one_line(here: Path) -> None:
    """As a command too: no traceback, nothing on stdout, exit code 2."""
    command = [sys.executable, "-m", "pacesetter", "train", "td3", TASK, "--gamma", "7"]
    found = subprocess.run(command, cwd=here, capture_output=True, text=True, check=False)
    assert (found.returncode, found.stdout) == (2, "")
    assert re.fullmatch(r"pacesetter: gamma: [^\n]*\n", found.stderr)
    assert not (here / "runs").exists()
