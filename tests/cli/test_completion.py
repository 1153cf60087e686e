"""Tab completes verbs, algorithms, tasks, settings and their words, and the names of runs."""

import importlib
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

from pacesetter.cli.main import VERBS, main

TRIES: dict[tuple[str, ...], set[str]] = {
    ("tr",): {"train"},
    ("train", "multi-cro"): {"multi-crossq"},
    ("train", "crossq-sm"): {"crossq-small"},
    ("train", "td3", "HalfCheetah-v5"): {"HalfCheetah-v5"},
    ("train", "sac", "Ant-v5", "--critic-h"): {"--critic-hidden"},  # of crossq alone
    ("train", "td3", "Ant-v5", "--copy", ""): {"full", "weights", "actor"},
    ("tune", "trpo", "Ant-v5", "--max-"): {"--max-kl"},
    ("show", "Ant"): {"Ant-v5/td3/0"},
    ("list", "al"): {"algorithms"},
    ("export", "--to", ""): {"onnx", "minari", "sb3"},
    ("bench", "smo"): {"smoke"},
    ("bench", "mine"): {"mine.toml"},
    ("bench", "smoke", "--algos", "crossq-sm"): {"crossq-small"},
    ("bench", "smoke", "--critic-h"): {"--critic-hidden"},
    ("train", "td3", "Ant-v5", "--rule", "resc"): {"rescue"},
    ("train", "td3", "Ant-v5", "--start-from", "Ant"): {"Ant-v5/td3/0"},
    ("push", "--video", "mi"): {"mine.toml"},
    ("show", "ru"): {"runs/"},
    ("completion", ""): {"bash", "zsh", "tcsh"},
}
ASK = """
source ./script.sh
try() { COMP_WORDS=(pacesetter "$@"); COMP_CWORD=$#; COMPREPLY=(); _shtab_pacesetter
        echo "${COMPREPLY[@]}"; }
"""


def test_bash_completes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["completion", "bash"]) == 0
    text = capsys.readouterr().out
    assert all(verb in text for verb in VERBS)
    Path("script.sh").write_text(text)
    Path("mine.toml").touch()
    (tmp_path / "runs" / "Ant-v5" / "td3" / "0").mkdir(parents=True)
    monkeypatch.setenv("CDPATH", str(tmp_path))  # where `cd runs` would print its folder
    lines = [f"try {' '.join(repr(word) for word in words)}" for words in TRIES]
    done = subprocess.run(["bash", "-c", ASK + "\n".join(lines)], capture_output=True, text=True)
    assert done.stderr == ""
    found = [{*line.split()} for line in done.stdout.splitlines()]
    assert found == [*TRIES.values()]


def test_bash_runs_nothing_of_a_folders_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """What it completes is quoted, so that not even Enter after Tab would run it."""
    monkeypatch.chdir(tmp_path)
    assert main(["completion", "bash"]) == 0
    Path("script.sh").write_text(capsys.readouterr().out)
    shown = 'source ./script.sh; _pacesetter_runs ""'
    done = subprocess.run(["bash", "-c", shown], capture_output=True, text=True)
    assert (done.stdout, done.stderr) == ("script.sh\n", "")  # without runs, no pattern
    for folder in ("runs/E/$(touch run)/0", "$(touch file)"):
        (tmp_path / folder).mkdir(parents=True)
    done = subprocess.run(["bash", "-c", shown], capture_output=True, text=True)
    typed = "".join(f"set -- {line}\n" for line in done.stdout.splitlines())
    assert subprocess.run(["bash", "-c", typed]).returncode == 0
    assert "E/\\$\\(touch\\ run\\)/0" in done.stdout
    assert not {"run", "file"} & {path.name for path in tmp_path.iterdir()}


@pytest.mark.parametrize("shell", ["zsh", "tcsh"])
def test_other_shells_read_theirs(
    shell: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["completion", shell]) == 0
    text = capsys.readouterr().out
    assert "--critic-layer-norm" in text or "critic-layer-norm" in text
    assert "MODULE:CLASS" not in text
    assert shell == "zsh" or "'n/show/f/'" in text.replace("*", "")
    if shutil.which(shell):
        (tmp_path / "script").write_text(text)
        done = subprocess.run([shell, "-n", tmp_path / "script"], capture_output=True, text=True)
        assert (done.returncode, done.stderr) == (0, "")


def test_help_is_help_again_afterwards(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["completion", "bash"]) == 0
    capsys.readouterr()
    with pytest.raises(SystemExit):
        main(["completion", "--help"])
    assert "Print a script for a shell" in capsys.readouterr().out


def test_without_shtab_one_line_says_how_to_get_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    real = importlib.import_module

    def missing(name: str, *rest: Any) -> Any:
        if name == "shtab":
            raise ImportError(name)
        return real(name, *rest)

    monkeypatch.setattr(importlib, "import_module", missing)
    assert main(["completion", "bash"]) == 2
    line = "pacesetter: completion: shtab is not installed; pip install 'pacesetter[completion]'\n"
    assert capsys.readouterr().err == line
    assert main(["completion", "fish"]) == 2
    assert "allowed: bash, tcsh, zsh" in capsys.readouterr().err
