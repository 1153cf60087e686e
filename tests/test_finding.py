"""A run is found under every name that a person would type for it."""

import re
from pathlib import Path

import pytest
from compare import make_run

from pacesetter.cli.main import main
from pacesetter.errors import UsageError
from pacesetter.runs import RunDirectory, find, find_group, find_matching


def made(runs: Path, env: str, name: str) -> RunDirectory:
    """A run that nobody trained, in the folder where `train` would put it."""
    path = make_run(runs, env, name, budget=1_000, evaluations=1)
    folder = runs / re.sub("[/:]", "-", env)
    if folder != path.parents[1]:
        path.parents[1].rename(folder)
    return RunDirectory(folder / name / "0")


NAMES = {
    "mywalker:MyPend-v0": ["mywalker:MyPend-v0", "mywalker-MyPend-v0", "MyPend-v0", "MyPend"],
    "my:dm_control/run-v0": ["my:dm_control/run-v0", "dm_control/run-v0", "run-v0",
                             "my-dm_control-run-v0"],
    "Pendulum-v1": ["Pendulum-v1", "Pendulum"],
}  # fmt: skip


@pytest.mark.parametrize("env", NAMES)
def test_every_spelling_of_a_task(env: str, runs: Path) -> None:
    one = made(runs, env, "td3")
    other = made(runs, "Ant-v5", "td3")
    for typed in NAMES[env]:
        assert find(f"{typed}/td3/0", runs).path == one.path, typed
        assert find(f"{typed}/td3", runs).path == one.path, f"{typed}, whose only seed this is"
        assert [run.path for run in find_group(f"{typed}/td3", runs)] == [one.path], typed
        assert [run.path for run in find_matching(f"{typed}/*", runs)] == [one.path], typed
        assert find(f"{runs}/{typed}/td3/0", runs).path == one.path, typed
    with pytest.raises(UsageError, match="matches"):
        find("td3/0", runs)
    assert [run.path for run in find_group("td3", runs)] == [other.path, one.path]


def test_a_colon_in_the_algorithm(runs: Path) -> None:
    one = made(runs, "Pendulum-v1", "third_party-Plain")
    assert find("Pendulum-v1/third_party:Plain/0", runs).path == one.path


def test_a_folders_own_name_comes_first(runs: Path) -> None:
    """The task of a module does not hide one of the same id without a module."""
    made(runs, "my:Ant-v5", "td3")
    plain = made(runs, "Ant-v5", "td3")
    assert find("Ant-v5/td3/0", runs).path == plain.path
    assert [run.path for run in find_group("Ant-v5/td3", runs)] == [plain.path]


@pytest.mark.parametrize("verb", ["show", "compare"])
def test_an_empty_name_is_one_line(
    verb: str, runs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made(runs, "Ant-v5", "td3")
    assert main([verb, " ", "--runs", str(runs)]) == 2
    assert "run: its name is empty" in capsys.readouterr().err


def test_train_prints_a_name_that_finds_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    words = ["train", "td3", "probe_envs:Scripted-v0", "--steps", "20", "--eval-episodes", "1"]
    for more, place in (([], Path("runs")), (["--runs", "elsewhere"], Path("elsewhere"))):
        assert main([*words, *more]) == 0
        (line,) = [x for x in capsys.readouterr().out.splitlines() if x.startswith("run: ")]
        name = line.removeprefix("run: ").split(",")[0]
        assert main(["show", name]) == 0, "without --runs"
        assert find(name).path == place / "probe_envs-Scripted-v0" / "td3" / "0"
        capsys.readouterr()
    assert main(["show", "probe_envs:Scripted-v0/td3/0"]) == 0


def test_what_is_near_is_not_called_allowed(capsys: pytest.CaptureFixture[str]) -> None:
    """Any task may be trained on: only near ones are named, or where to see them all."""
    for typed, said in (
        ("nowhere/cheetah-run-v0", "see `pacesetter list envs`"),
        ("HalfCheeta-v5", "did you mean HalfCheetah-v5"),
    ):
        assert main(["train", "td3", typed]) == 2
        line = capsys.readouterr().err
        assert said in line
        assert "allowed" not in line


@pytest.mark.parametrize("name", [".", "*", "td*", "Ant-v5/*"])
def test_a_pattern_or_a_folder_is_no_run(name: str, runs: Path) -> None:
    """Even where it would fit one run only: `resume` must not guess."""
    made(runs, "Ant-v5", "td3")
    with pytest.raises(UsageError, match="not found"):
        find(name, runs)
