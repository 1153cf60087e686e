"""The commands: help, lists, settings from all their places, budgets, and going on."""

import json
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import demo
import jax
import pytest
from short_runs import TINY, assert_same, run_to_end
from stopping import raiser

from pacesetter import algorithms, config
from pacesetter.algorithms import ddpg
from pacesetter.batch import Spec
from pacesetter.cli import progress
from pacesetter.cli.flags import add_settings, parser, split_env_kwargs
from pacesetter.cli.main import VERBS, main
from pacesetter.config import Run, resolve
from pacesetter.evaluation import evaluate
from pacesetter.policy import load
from pacesetter.runs import RunDirectory, find
from pacesetter.settings.validation import fields_of
from pacesetter.training.trainer import Trainer

PROBE = "broken_envs:Probe-v0"
SMALL = [
    "--hidden",
    "16",
    "16",
    "--batch-size",
    "16",
    "--replay-size",
    "10k",
    "--eval-episodes",
    "1",
    "--warmup",
    "100",
    "-q",
]
Command = Callable[..., str]


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Commands run in an empty folder, on a wide terminal."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "160")
    return tmp_path


@pytest.fixture
def command(capsys: pytest.CaptureFixture[str]) -> Command:
    """Run a command that must succeed; what it prints."""

    def run(*words: object) -> str:
        try:
            code: Any = main([str(word) for word in words])
        except SystemExit as end:
            code = end.code
        printed = capsys.readouterr()
        assert (code, printed.err) == (0, "")
        return printed.out

    return run


def trained(command: Command, algorithm: str, *flags: object, env: str = PROBE) -> RunDirectory:
    """A small run made by the command."""
    before = {run.path for run in _all()}
    command("train", algorithm, env, *SMALL, *flags)
    (new,) = [run for run in _all() if run.path not in before]
    return new


def _all() -> list[RunDirectory]:
    return [RunDirectory(path.parent) for path in Path("runs").rglob("config.json")]


# Help and lists.

HELP = {
    "resume": ["RUN", "--steps", "--time", "--runs", "--quiet"],
    "eval": ["RUN|FILE", "--episodes", "--seed", "--noise", "--env", "--json", "--runs"],
    "list": ["algorithms|envs|rules|presets|suites|champions|runs", "--runs"],
    "bench": ["SUITE|FILE.toml", "pilot", "--algos", "--envs", "--seeds", "--jobs", "--print"],
    "tune": ["ALGO", "ENV", "--trials", "--study"],
    "show": ["RUN", "--runs"],
    "train": ["ALGO", "ENV", "--help"],
}


@pytest.mark.parametrize("verb", VERBS)
def test_help_of_a_verb(verb: str, command: Command) -> None:
    text = command(verb, "--help")
    assert f"pacesetter {verb}" in text
    assert [word for word in HELP.get(verb, []) if word not in text] == []


def test_overview(command: Command) -> None:
    """Every verb with a line of its own, however help is asked for."""
    text = command("--help")
    assert text == command("-h")
    for verb in VERBS:
        assert re.search(rf"^  {verb} +\w.*\.$", text, re.MULTILINE), verb
    assert re.fullmatch(r"\d+\.\d+\.\d+\n", command("--version"))


def test_no_words_shows_the_overview(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 2
    assert "usage" in capsys.readouterr().out


# algorithm, env: some flag and its default there.
DEFAULTS = {
    ("td3", "Ant-v5"): {"warmup": "25000", "batch-size": "256", "hidden": "256 256"},
    ("td3-paper", "Ant-v5"): {"warmup": "10000", "batch-size": "100", "hidden": "400 300"},
    ("td3-paper", "pacesetter/Ant111-v4"): {"warmup": "10000"},
    ("td3-paper", "Hopper-v5"): {"warmup": "1000", "members": "1"},
    ("multi-td3", "Ant-v5"): {"members": "2", "warmup": "25000", "name": "multi-td3"},
    ("multi-td3-paper", "Ant-v5"): {"members": "2", "warmup": "10000"},
    ("ddpg", "Ant-v5"): {"critics": "1", "action-layer": "0"},
    ("ddpg-original", "HalfCheetah-v5"): {"warmup": "10000", "exploration": "ou"},
    ("crossq", "Ant-v5"): {"critic-hidden": "2048 2048", "exploration": "policy"},
    ("crossq-small", "Ant-v5"): {"critic-hidden": "256 256", "hidden": "256 256"},
    ("quick", "HalfCheetah-v5"): {
        "critic-hidden": "256 256",
        "precision": "bf16",
        "eval-policy": "ema",
    },
    ("frugal", "Ant-v5"): {
        "encoder-size": "96",
        "batch-size": "128",
        "precision": "bf16",
        "eval-policy": "ema",
    },
}


@pytest.mark.parametrize(("algorithm", "env"), DEFAULTS)
def test_help_shows_the_defaults_of_a_preset(algorithm: str, env: str, command: Command) -> None:
    text = re.sub(r"\s+", " ", command("train", algorithm, env, "--help"))
    for flag, value in DEFAULTS[algorithm, env].items():
        found = re.search(rf" --{flag}[ ,][^()]*(?:\([^()]*\) )*?\([^()]*default ([^)]*)\)", text)
        assert found, flag
        assert found[1] == value, flag


def test_help_of_train_has_every_setting(command: Command) -> None:
    """With the range of each that has one."""
    text = re.sub(r"\s+", " ", command("train", "ddpg", "Ant-v5", "--help"))
    names = [field.name for kind in (Run, ddpg.Hyper) for field in fields(kind)]
    hidden = {"algorithm", "env", "env_kwargs", "wrap"}
    assert [n for n in names if f"--{n.replace('_', '-')}" not in text and n not in hidden] == []
    assert "at least 0; at most 1; default 0.99" in text
    assert "full, weights or actor; default full" in text
    assert not Path("runs").exists()


NO_JAX = """
import sys
from pacesetter.cli.main import main
for words in ["--help", "--version", "train --help", "resume --help", "eval --help", "list --help",
              "show --help", "bench --help", "tune --help", "list algorithms", "list envs",
              "list rules", "list presets", "list suites", "list runs"]:
    try:
        code = main(words.split())
    except SystemExit as end:
        code = end.code
    assert code == 0, words
    assert "jax" not in sys.modules, words
"""


def test_help_and_lists_import_no_jax() -> None:
    found = subprocess.run([sys.executable, "-c", NO_JAX], capture_output=True, text=True)
    assert (found.returncode, found.stderr) == (0, "")


LISTS = {
    "algorithms": ["td3", "ddpg", "multi-td3", "multi-ddpg"],
    "envs": ["HalfCheetah-v5", "Ant-v4", "Humanoid-v5", "pacesetter/Ant111-v4", "module:Id"],
    "rules": ["none", "best", "random", "top_half", "tournament"],
    "presets": ["td3-paper", "ddpg-original", "quick", "frugal", "Fujimoto", "Lillicrap"],
    "suites": ["smoke", "pilot", "published", "paper-table-1", "paper-table-2"],
    "runs": ["no runs below runs"],
}


@pytest.mark.parametrize("noun", LISTS)
def test_list(noun: str, command: Command) -> None:
    text = command("list", noun)
    assert [word for word in LISTS[noun] if word not in text] == []
    assert "-v2\n" not in text
    assert "-v3\n" not in text


def test_list_and_show_runs(command: Command) -> None:
    """Steps, state and return of each run; settings, evaluations and versions of one."""
    first = trained(command, "td3", "--steps", 150, "--eval-every", 100)
    second = trained(command, "multi-td3", "--steps", 120, "--warmup", 1000, "--seed", 5)
    means = [row["mean"] for row in first.rows() if row["kind"] == "eval"]
    lines = command("list", "runs").splitlines()
    (line,) = [line for line in lines if str(first.path) in line]
    assert "150 of 150" in line
    assert "finished" in line
    assert f"{means[-1]:.1f}" in line
    assert any(str(second.path) in line and "120 of 120" in line for line in lines)
    assert first.record()["backend"] == "cpu"
    text = command("show", "multi-td3/5")
    for word in ("120 of 120 steps, finished", "member_steps", "[60, 60]", "jax", "gamma"):
        assert word in text, word
    shown = command("show", first.path)
    for step, mean in zip((0, 100, 150), means, strict=True):
        assert re.search(rf"^{step} +{re.escape(f'{mean:.1f}')} ", shown, re.MULTILINE)


def test_list_alone_names_everything(command: Command) -> None:
    """The hint of a refusal, `see pacesetter list`, leads to every kind with its names."""
    text = command("list")
    for kind in (*LISTS, "champions"):
        assert re.search(rf"^{kind} +\S", text, re.MULTILINE), kind
    for name in ("multi-td3", "HalfCheetah-v5", "top_half", "crossq-small", "pilot", "champion:"):
        assert name in text, name
    assert max(map(len, text.splitlines())) <= 88


def test_lists_as_json(command: Command) -> None:
    run = trained(command, "td3", "--steps", 120)
    (row,) = json.loads(command("list", "runs", "--json"))
    assert row["return"] == run.rows("eval")[-1]["mean"]
    assert {key: row[key] for key in ("name", "step", "budget", "state")} == {
        "name": str(run.path), "step": 120, "budget": 120, "state": "finished"
    }  # fmt: skip
    every = json.loads(command("list", "--json"))
    assert {*every} == {*LISTS, "champions"}
    assert all(each["name"] for rows in every.values() for each in rows)


def test_show_says_what_it_leaves_out(command: Command) -> None:
    run = trained(command, "td3", "--steps", 160, "--eval-every", 20)
    steps = [row["step"] for row in run.rows("eval")]
    assert len(steps) == 9
    text = command("show", run.path)
    assert "4 earlier evaluations left out; --all shows every one" in text
    assert "\n0 " not in text
    assert re.search(r"^time +-$", text, re.MULTILINE), "a setting without a value shows a dash"
    text = command("show", run.path, "--all")
    assert "left out" not in text
    assert all(re.search(rf"^{step} ", text, re.MULTILINE) for step in steps)
    told = json.loads(command("show", run.path, "--json"))
    assert [row["step"] for row in told["evaluations"]] == steps
    assert told["settings"] == run.settings()
    assert told["ledger"]["updates"] == run.rows()[-1]["updates"]


# Settings.

COUNTS = {"5000": 5_000, "300k": 300_000, "1M": 1_000_000, "1e6": 1_000_000, "1.5k": 1_500,
          "2.5M": 2_500_000, "1E3": 1_000, " 7 ": 7, "1e3k": 1_000_000}  # fmt: skip
DURATIONS = {"90": 90, "90s": 90, "5m": 300, "2h": 7_200, "1d": 86_400, "0.5h": 1_800, "1.5s": 1.5}


@pytest.mark.parametrize("text", COUNTS)
def test_counts(text: str) -> None:
    run, hyper = resolve("td3", "X-v0", {"steps": text, "replay_size": text})
    assert run.steps == hyper.replay_size == COUNTS[text]
    assert type(run.steps) is int


@pytest.mark.parametrize("text", DURATIONS)
def test_durations(text: str) -> None:
    run, _ = resolve("td3", "X-v0", {"time": text, "checkpoint_every": text})
    assert run.time == run.checkpoint_every == DURATIONS[text]


def test_env_keywords() -> None:
    """TOML values where they are, else text; the other words stay."""
    words = "--env.a 1 --x --env.b=2.5 --env.c true y --env.d-e text --env.f [1,2] --env.g=a=b"
    rest, found = split_env_kwargs(words.split())
    assert rest == ["--x", "y"]
    assert found == {"a": 1, "b": 2.5, "c": True, "d_e": "text", "f": [1, 2], "g": "a=b"}


def test_flags_over_file_over_preset_over_defaults(command: Command, here: Path) -> None:
    """Each layer wins over those below it, and only where it says something."""
    (here / "file.toml").write_text(
        'batch-size = 8\nhidden = [8, 8]\nwarmup = "20"\ngamma = 0.5\nenv_kwargs = {gain = 3}\n'
    )
    flags = ["--config", "file.toml", "--batch-size", 4, "--gamma", "0.6", "--steps", 30, "-q"]
    command("train", "td3-paper", PROBE, *flags, "--eval-episodes", 1)
    settings = find("td3-paper/0").settings()
    expected = {
        "batch_size": 4,  # flag over file and preset
        "gamma": 0.6,  # flag over file
        "warmup": 20,  # file over preset
        "hidden": [8, 8],
        "env_kwargs": {"gain": 3},
        "actor_learning_rate": 1e-3,  # preset over default
        "update_at": "episode",
        "tau": 0.005,  # default
        "name": "td3-paper",
        "algorithm": "td3",
    }
    assert {key: settings[key] for key in expected} == expected


def test_config_of_a_run_makes_it_again(command: Command, here: Path) -> None:
    """config.json given as --config repeats the run, bit for bit."""
    first = trained(command, "multi-td3", "--steps", 260, "--tau", "0.02", "--env.gain", 2)
    again = ["train", "td3", PROBE, "--config", first.config_file, "--runs", "again", "-q"]
    command(*again)
    assert_same(first, find("multi-td3/0", "again"))


def test_config_of_a_run_of_something_else(
    command: Command, capsys: pytest.CaptureFixture[str]
) -> None:
    """It holds all settings, and the folder's name, so that nothing asked for would be left."""
    file = str(trained(command, "td3", "--steps", 150).config_file)
    assert main(["train", "multi-td3", PROBE, "--config", file, "--seed", "5"]) == 2
    line = capsys.readouterr().err
    assert file in line
    assert "td3; they cannot be those of multi-td3" in line


def test_a_run_whose_time_is_up_is_finished(command: Command) -> None:
    run = trained(command, "td3", "--steps", "1M", "--warmup", "1M", "--time", "1s")
    assert run.rows()[-1]["step"] < 1_000_000
    assert "finished" in command("list", "runs")


def test_env_keyword_reaches_the_task(command: Command) -> None:
    """Twice the gain is twice the return of the same actions, in the run and for its file."""
    first = trained(command, "td3", "--steps", 1, "--name", "one")
    second = trained(command, "td3", "--steps", 1, "--name", "two", "--env.gain", "2")
    returns = [run.rows()[0]["returns"] for run in (first, second)]
    assert returns[1] == pytest.approx([2 * value for value in returns[0]])
    told = [json.loads(command("eval", run.path, "--episodes", 1, "--json")) for run in
            (first, second)]  # fmt: skip
    assert told[1]["mean"] == pytest.approx(2 * told[0]["mean"])
    assert load(second.policy_file).about["env_kwargs"] == {"gain": 2}


# Runs that together use every flag, and the settings that differ from what is typed.
SWITCHES: dict[str, tuple[str, dict[str, Any]]] = {
    "td3": (
        "--steps 0.3k --seed 3 --name all.of-it --time 10m --env-timeout 1m --device cpu "
        "--checkpoint-every 1h "
        "--eval-every 150 --eval-episodes 2 --hidden 8 6 --batch-size 8 --replay-size 1k "
        "--warmup 50 --warmup-updates --updates-per-step 0.5 --update-at episode "
        "--actor-learning-rate 1e-3 "
        "--critic-learning-rate 2e-3 --tau 0.01 --critics 3 --policy-delay 3 --target-noise 0.1 "
        "--target-noise-clip 0.2 --exploration ou --exploration-noise 0.3 --critic-layer-norm "
        "--actor-layer-norm --gamma 0.9 --normalize-observation --quantiles 3 --replay uniform "
        "--precision bf16 --no-renew-env",
        {
            "steps": 300,
            "time": 600,
            "env_timeout": 60,
            "checkpoint_every": 3600,
            "replay_size": 1000,
        },
    ),
    "multi-td3": (
        "--steps 400 --members 3 --rule top_half --select-on eval --select-every 130 "
        "--select-window 2 --copy weights --same-init --count member --no-wait "
        "--replay-scope member --update-every 4 --select-after 60 --no-count-selection-steps",
        {},
    ),
    "multi-ddpg": (
        "--steps 500 --rule tournament --select-window 1 --copy actor --action-layer 1 "
        "--critic-decay 0.01 --output-bound 0.003 --critics 1 --policy-delay 1 --target-noise 0",
        {},
    ),
    "sac": (
        "--steps 300 --hidden 8 --batch-size 8 --warmup 50 --replay return --replay-exponent 0.5 "
        "--replay-importance 0.3 --replay-horizon 1000 --replay-to-go --n-step 3 --assess 2 "
        "--assess-after 100 --actor-observes :2",
        {},
    ),
    "multi-sac": (
        "--steps 600 --hidden 8 --batch-size 8 --warmup 50 --num-envs 2 --lr-end 0.5 "
        "--lr-horizon 900 --stop-at 1000000 --stop-patience 99 --normalize-reward --keep 2 "
        "--mean-actions on --ema-tau 0.1 --eval-policy ema "
        "--snapshots 2 --no-renew-env --vary gamma=0.98,0.99 --vary-by draw",
        {"vary": {"gamma": [0.98, 0.99]}},
    ),
    "crossq": (
        "--steps 200 --hidden 8 --critic-hidden 8 6 --batch-size 8 --warmup 50 --critics 3 "
        "--policy-delay 2 --adam-momentum 0.9 --renorm-after 20 --alpha-learning-rate 1e-2 "
        "--initial-alpha 0.5 --target-entropy -1 --exploration policy",
        {},
    ),
}


def typed(text: str) -> dict[str, Any]:
    """What a line of flags sets, as config.json would have it."""
    table: dict[str, Any] = {}
    for part in text.split("--")[1:]:
        flag, *values = part.split()
        if not values:
            table[flag.removeprefix("no-").replace("-", "_")] = not flag.startswith("no-")
            continue
        found = [_number(value) for value in values]
        table[flag.replace("-", "_")] = found if flag.endswith("hidden") else found[0]
    return table


def _number(text: str) -> Any:
    try:
        return json.loads(text)
    except ValueError:
        return text


@pytest.mark.parametrize("algorithm", SWITCHES)
def test_flags_are_settings(algorithm: str, command: Command) -> None:
    """Each flag lands in config.json and the run goes to its end with it."""
    text, others = SWITCHES[algorithm]
    directory = trained(command, algorithm, *text.split())
    settings = directory.settings()
    expected = typed(text) | others
    assert {key: settings[key] for key in expected} == expected
    *_, last = directory.rows()
    members = settings["members"] if settings["count"] == "member" else 1
    assert last["step"] == settings["steps"] * members
    assert last["updates"] > 0
    assert directory.path.parts[-2:] == (settings["name"], str(settings["seed"]))


@pytest.mark.parametrize("algorithm", algorithms.TABLE)
def test_every_default_may_be_typed(algorithm: str) -> None:
    """Each setting of each algorithm has a flag, and its default spelled out changes nothing."""
    found = resolve(algorithm, "HalfCheetah-v5")
    settings = {
        key: value for key, value in found.settings().items() if value not in (None, (), {})
    }
    words: list[str] = []
    for name in settings.keys() - {"algorithm", "env"}:
        value, flag = settings[name], name.replace("_", "-")
        if isinstance(value, bool):
            words.append(f"--{flag}" if value else f"--no-{flag}")
        else:
            words += [f"--{flag}", *map(str, value if isinstance(value, list | tuple) else [value])]
    command = parser("train", "")
    for kind in (Run, algorithms.find(algorithm).Hyper):
        add_settings(command, "settings", kind, None)
    given = vars(command.parse(words))
    assert given.keys() == settings.keys() - {"algorithm", "env"}
    assert resolve(algorithm, "HalfCheetah-v5", given) == found


def test_every_flag_of_a_run_and_of_ddpg_is_tried() -> None:
    """A new setting of these needs a place in SWITCHES."""
    tried = {name for text, _ in SWITCHES.values() for name in typed(text)}
    settings = fields_of(Run).keys() | fields_of(ddpg.Hyper).keys()
    own_tests = {"start_from", "wrap", "randomize"}  # which need a run, a module, a keyword
    assert settings - tried == {"algorithm", "env", "env_kwargs"} | own_tests


# Those of learners with a state of their own kind are built beside the other tests of it.
BUILT = [
    n for n, table in config.presets().items() if not algorithms.single_member(table["algorithm"])
]


@pytest.mark.parametrize("name", [*BUILT, *(f"multi-{name}" for name in BUILT)])
def test_every_preset_builds(name: str) -> None:
    """On HalfCheetah; its values are those of the file."""
    run, hyper = resolve(name, "HalfCheetah-v5")
    learner = algorithms.find(run.algorithm).build(Spec(17, 6), hyper)
    state = jax.eval_shape(learner.init, jax.random.key(0))
    assert state.actor[0]["kernel"].shape[-2:] == (17, hyper.hidden[0])
    outputs = 12 if run.algorithm in ("sac", "crossq", "sunrise") else 6  # means and log deviations
    assert state.actor[-1]["kernel"].shape[-2:] == (hyper.hidden[-1], outputs)
    assert run.members == (2 if "multi-" in name else 1)
    table = config.presets()[name.removeprefix("multi-")]
    assert table["help"]
    assert table["source"]
    narrow = table.get("env", {}).get("HalfCheetah-*", {})
    told = {k: v for k, v in table.items() if k not in ("algorithm", "help", "source", "env")}
    settings = {**vars(run), **vars(hyper)}
    for key, value in (told | narrow).items():
        assert settings[key] == (tuple(value) if isinstance(value, list) else value), key


# Budgets.


def test_time_ends_a_run(command: Command) -> None:
    """And more time lets it go on."""
    flags = ["--steps", "1M", "--warmup", "1M", "--eval-every", "1M", "--time", "1s"]
    directory = trained(command, "td3", *flags)
    first = directory.rows()[-1]
    assert (first["kind"], first["step"] > 0) == ("eval", True)
    assert 1 <= first["wall_seconds"] < 30  # a minute would be 60
    assert first["step"] < 1_000_000
    command("resume", directory.path, "--time", "2s", "-q")
    last = directory.rows()[-1]
    assert last["step"] > first["step"]
    assert last["wall_seconds"] >= 2
    assert directory.settings()["time"] == 2


def test_more_steps_equal_a_larger_budget(command: Command) -> None:
    """If the first budget ends where a row of the log is due anyway."""
    flags = ["--eval-every", 500]
    whole = trained(command, "td3", *flags, "--steps", "2k", "--name", "whole")
    parts = trained(command, "td3", *flags, "--steps", "1k", "--name", "parts")
    assert "2,000 steps" in command("resume", "parts/0", "--steps", "2k", "-q")
    assert parts.settings()["steps"] == 2_000
    assert_same(whole, parts)


@pytest.mark.parametrize("steps", [150, 200])
def test_resume_of_a_finished_run_changes_nothing(
    steps: int, command: Command, capsys: pytest.CaptureFixture[str]
) -> None:
    """In the middle of an episode and at its end; a line says so, and what to give."""
    directory = trained(command, "td3", "--steps", steps)
    before = RunDirectory(Path(shutil.copytree(directory.path, "before")))
    capsys.readouterr()
    assert main(["resume", str(directory.path), "-q"]) == 0
    out, err = capsys.readouterr()
    assert f"{steps} steps" in out
    assert err.startswith("pacesetter: budget: nothing is left to do; to go on, give more --steps")
    assert_same(directory, before)


def test_progress_goes_to_stderr(capsys: pytest.CaptureFixture[str]) -> None:
    """A line an evaluation there; the result and the file on stdout."""
    words = ["train", "td3", PROBE, *SMALL[:-1], "--steps", "250", "--eval-every", "100"]
    assert main(words) == 0
    out, err = capsys.readouterr()
    assert [line.split("  ")[0] for line in err.splitlines()] == [
        f"step {step} of 250" for step in (0, 100, 200, 250)
    ]
    result, policy, name, watch = out.splitlines()
    assert re.fullmatch(rf"{PROBE} td3 seed 0: 250 steps, return -?[\d.]+ at step 250", result)
    file = Path(policy.removeprefix("policy: "))
    assert file.is_file()
    called = Path(*file.parent.parts[-3:])
    assert name == f"run: {called}, a name for show, eval, record, resume and compare"
    assert watch == f"film it: `pacesetter record {called} -o walk.mp4 --allow {PROBE}`"


def test_out_of_memory_is_one_line(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(VERBS, "list", raiser(MemoryError("9 GB")))
    assert main(["list"]) == 1
    out, err = capsys.readouterr()
    assert (out, err.count("\n")) == ("", 1)
    assert "out of memory: 9 GB; ask for less, such as fewer members" in err


def test_a_bar_on_a_terminal(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The bar shows the run's steps and returns, and a warning is printed whole above it."""
    warning = "at 1 update per second this run takes about [5 days] on this machine; Ctrl-C saves"
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    monkeypatch.setattr(progress, "LOOK_EVERY", 0.0)
    said = iter([warning])
    monkeypatch.setattr(progress.Slowness, "look", lambda *_: next(said, None))
    monkeypatch.setenv("COLUMNS", "160")
    assert main(["train", "td3", PROBE, *SMALL[:-1], "--steps", "250", "--eval-every", "100"]) == 0
    out, err = capsys.readouterr()
    assert f"pacesetter: {warning}" in err
    assert f"{PROBE} td3 0" in err
    assert "250/250" in err
    assert "ETA" in err
    assert out.startswith(f"{PROBE} td3 seed 0: 250 steps, return ")


def test_eval_of_a_run(command: Command) -> None:
    """By its folder, its tail or its file; a module is imported for a run of one's own."""
    directory = trained(command, "td3", "--steps", 1)
    names = (directory.path, "td3/0", "0")
    texts = [command("eval", name, "--episodes", 2, "--json") for name in names]
    returns = [json.loads(text)["returns"] for text in texts]
    assert returns[0] == returns[1] == returns[2]
    text = command("eval", directory.path, "--episodes", 2)
    assert re.fullmatch(
        rf"{PROBE}: return -?[\d.]+ \+- [\d.]+ over 2 episodes of 100 steps; policy of step 1\n",
        text,
    )


def test_eval_of_uniform_actions_and_longer_episodes(command: Command) -> None:
    """The same task without the policy, and with another keyword of its constructor."""
    directory = trained(command, "td3", "--steps", 1)
    words = ("eval", directory.path, "--episodes", 2, "--json")
    short = json.loads(command(*words, "--env.max_episode_steps", 7))
    assert short["lengths"] == [7, 7]
    assert short["env_kwargs"] == {"max_episode_steps": 7}
    text = command("eval", directory.path, "--episodes", 2, "--random")
    assert text.endswith("over 2 episodes of 100 steps; uniform actions\n")
    drawn = json.loads(command(*words, "--random"))
    assert drawn["policy"] is None
    assert drawn["returns"] == evaluate(None, PROBE, 2).returns


def test_the_demo_saves_on_ctrl_c(runs: Path) -> None:
    """The first signal ends it after the running tick, with all saved."""
    trainer = Trainer("td3", PROBE, runs=runs, **{**TINY, "steps": 100_000})
    tick = trainer.loop.tick

    def interrupted() -> Any:
        if trainer.progress.step == 50:
            signal.raise_signal(signal.SIGINT)
        return tick()

    trainer.loop.tick = interrupted
    assert not demo.train(trainer)
    resumed = Trainer.resume(trainer.directory.path)
    resumed.close()
    assert resumed.progress.step == 51


def test_the_demo_begins_a_run_and_takes_it_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    trainer = demo.open_run()
    for _ in trainer:
        break
    again = demo.open_run()
    again.close()
    for each in (trainer, again):
        assert each.config.run.env == "HalfCheetah-v5"
        assert each.config.hyper.encoder_size == resolve("td7-small", demo.ENV).hyper.encoder_size
        assert each.config.hyper.precision == demo.PRECISION
        assert each.config.run.time == 300


def test_iterator_breaks_and_goes_on(runs: Path) -> None:
    """`break` saves; `resume` continues; both together equal one run."""
    settings = {**TINY, "steps": 700, "eval_every": 200}
    whole = run_to_end(Trainer("td3", PROBE, runs=runs, name="whole", **settings))
    trainer = Trainer("td3", PROBE, runs=runs, name="broken", **settings)
    seen = []
    for report in trainer:
        seen.append((report.kind, report.step))
        if report.step == 400:
            break
    del report
    assert seen == [("eval", 0), ("eval", 200), ("eval", 400)]
    assert not trainer.directory.in_use()
    resumed = Trainer.resume("broken/0", runs=runs)
    assert resumed.progress.step == 400
    assert [report.step for report in resumed if report.kind == "eval"] == [600, 700]
    assert_same(whole, resumed.directory)
