"""A folder or a file that names a module has it imported only if the command line names it too."""

import json
import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import gymnasium
import pytest
from short_runs import TINY, run_to_end

from pacesetter import Trainer, load
from pacesetter.cli.main import main
from pacesetter.errors import UsageError
from pacesetter.runs import RunDirectory

ENV, ALGORITHM = "intruder:Intruder-v0", "intruder:Learner"
# Both the task and the learner are real, so that what is allowed also works.
INTRUDER = """
from pathlib import Path
import gymnasium
from pacesetter.algorithms.td3 import TD3 as Learner
Path("intruded").touch()
gymnasium.register("Intruder-v0", entry_point="broken_envs:Probe")
"""
SUITE = """
steps = 20
seeds = 1
[entries.mine]
algorithm = "{algorithm}"
envs = ["{env}"]
"""
SMALL = ["--hidden", "4", "--batch-size", "4", "--eval-episodes", "1"]

Run = Callable[..., int]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> RunDirectory:
    """A short run of td3 on a harmless task."""
    runs = tmp_path_factory.mktemp("made") / "runs"
    settings = TINY | {"steps": 40, "hidden": (4,), "batch_size": 4}
    return run_to_end(Trainer("td3", "broken_envs:Probe-v0", runs=runs, **settings))


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder from which `intruder` can be imported; nobody has done so yet."""
    (tmp_path / "intruder.py").write_text(INTRUDER)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    yield tmp_path
    forget()


def forget() -> None:
    """As in a new process."""
    sys.modules.pop("intruder", None)
    gymnasium.registry.pop("Intruder-v0", None)


def trap(made: RunDirectory, here: Path, **settings: str) -> RunDirectory:
    """A copy of the run whose files name what they should not."""
    run = RunDirectory(Path(shutil.copytree(made.path, here / "runs" / "trap")))
    table = json.loads(run.config_file.read_text())
    table["settings"] |= settings
    run.config_file.write_text(json.dumps(table))
    policy = load(run.policy_file)
    policy.about.update(settings)
    policy.save(run.policy_file)
    return run


def refuses(capsys: pytest.CaptureFixture[str], name: str, *words: object) -> None:
    """The command ends with one line that names the flag, and nothing was imported."""
    assert main([str(word) for word in words]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    assert f"--allow {name}" in captured.err
    assert not Path("intruded").exists()
    assert "intruder" not in sys.modules


@pytest.mark.parametrize("verb", ["eval", "resume", "record", "poster", "push", "watch"])
def test_a_run_that_names_a_module(
    verb: str, made: RunDirectory, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = trap(made, here, env=ENV)
    words = [verb, run.path, *(["me/it"] if verb == "push" else [])]
    refuses(capsys, ENV, *words)
    refuses(capsys, ENV, *words, "--allow", "other:Name-v0")


@pytest.mark.parametrize("target", ["minari", "sb3"])
def test_an_export_of_a_policy_that_names_a_module(
    target: str, made: RunDirectory, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = trap(made, here, env=ENV)
    out = "walk.py" if target == "sb3" else "walk-v0"
    refuses(capsys, ENV, "export", run.path, "--to", target, "-o", out)


def test_a_run_that_names_an_algorithm(
    made: RunDirectory, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = trap(made, here, algorithm=ALGORITHM)
    refuses(capsys, ALGORITHM, "resume", run.path, "--allow", "broken_envs:Probe-v0")
    with pytest.raises(UsageError, match="--allow intruder:Learner"):
        Trainer.resume(run.path)
    assert "intruder" not in sys.modules


@pytest.mark.parametrize("flags", [["--env", ENV], ["--allow", ENV]])
def test_eval_of_what_is_named_or_allowed(
    flags: list[str], made: RunDirectory, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = trap(made, here, env=ENV)
    assert main(["eval", str(run.path), "--episodes", "1", *flags]) == 0
    assert "intruder:Intruder-v0: return" in capsys.readouterr().out
    assert Path("intruded").exists()


def test_resume_of_a_run_that_was_trained_here(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """`train` names what it imports; the command that it prints goes on with the run."""
    words = [ALGORITHM, ENV, "--steps", "20", "--warmup", "9", *SMALL, "--name", "mine"]
    assert main(["train", *words]) == 0
    forget()
    Path("intruded").unlink()
    capsys.readouterr()
    path = Path("runs/intruder-Intruder-v0/mine/0")
    again = ["resume", path, "--steps", "30"]
    refuses(capsys, ALGORITHM, *again)
    refuses(capsys, ENV, *again, "--allow", ALGORITHM)
    capsys.readouterr()
    assert main(["train", *words]) == 2
    line = capsys.readouterr().err
    assert f"resume {path} --allow {ALGORITHM} --allow {ENV}" in line
    allowed = ["--allow", ALGORITHM, "--allow", ENV]
    assert main([*map(str, again), *allowed]) == 0


def test_bench_looks_up_nothing_in_a_folder_that_it_did_not_make(
    made: RunDirectory, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = trap(made, here, algorithm=ALGORITHM)
    place = here / "runs" / "HalfCheetah-v5" / "td3" / "0"
    place.parent.mkdir(parents=True)
    run.path.rename(place)
    words = ["bench", "--algos", "td3", "--envs", "HalfCheetah-v5", "--seeds", "1"]
    for start in (words, ["train", "td3", "HalfCheetah-v5"]):
        assert main(start) == 2
        assert f"algorithm={ALGORITHM}, not td3" in capsys.readouterr().err
    assert "intruder" not in sys.modules


@pytest.mark.parametrize(("algorithm", "env"), [(ALGORITHM, "Pendulum-v1"), ("td3", ENV)])
def test_a_suite_that_names_a_module(
    algorithm: str, env: str, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("suite.toml").write_text(SUITE.format(algorithm=algorithm, env=env))
    name = algorithm if ":" in algorithm else env
    words = ["bench", "suite.toml", "--print", "commands"]
    refuses(capsys, name, *words)
    refuses(capsys, name, *words, "--help")
    assert main([*words, "--allow", name, "--runs", str(here / "runs")]) == 0
    (line,) = capsys.readouterr().out.splitlines()
    assert f"-q --allow {name}" in line.replace("'", "") or f"--allow {name} -q" in line


def test_a_suite_whose_tasks_are_named_anew(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The command line's tasks replace the file's, which then import nothing."""
    Path("suite.toml").write_text(SUITE.format(algorithm="td3", env=ENV))
    assert main(["bench", "suite.toml", "--envs", "Pendulum-v1", "--print", "commands"]) == 0
    assert "Pendulum-v1" in capsys.readouterr().out
    assert "intruder" not in sys.modules


def test_a_program_that_uses_the_module_already(made: RunDirectory, here: Path) -> None:
    """What is imported already imports nothing more, so Python programs need no list."""
    import intruder  # pyright: ignore[reportMissingImports]

    assert intruder.Learner
    run = trap(made, here, algorithm="td3", env="broken_envs:Probe-v0")
    Trainer.resume(run.path).close()


@pytest.mark.parametrize("wrap", ['["intruder:Learner"]', "5", "[5]"])
def test_a_wrapper_that_a_file_names(
    wrap: str, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """In a config, in a suite, and in the config file of a suite's entry."""
    Path("mine.toml").write_text(f"wrap = {wrap}\n")
    text = SUITE.format(algorithm="td3", env="Pendulum-v1")
    Path("one.toml").write_text(f"wrap = {wrap}\n{text}")
    Path("two.toml").write_text(f'{text}config = "mine.toml"\n')
    printed = ["--print", "commands"]
    train = ["train", "td3", "Pendulum-v1", "--config", "mine.toml"]
    for words in (train, ["bench", "one.toml", *printed], ["bench", "two.toml", *printed]):
        assert main(words) == 2, words
        line = capsys.readouterr().err
        assert "wrap: " in line
        assert line.count("\n") == 1
        flag = "--wrap" if words is train else "--allow"  # which `train` has not
        assert ("intruder" in wrap) == (f"{flag} intruder:Learner" in line)
    assert "intruder" not in sys.modules
