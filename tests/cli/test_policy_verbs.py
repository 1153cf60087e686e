"""The verbs that take a policy: which one a word means, and what they hand to `media`."""

import json
import re
import runpy
import subprocess
import sys
import zipfile
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import create_autospec

import numpy as np
import pytest
from policies import untrained
from short_runs import TINY, run_to_end

from pacesetter.cli.main import main
from pacesetter.evaluation import evaluate
from pacesetter.media import hub
from pacesetter.media import record as film_module
from pacesetter.media.record import Film
from pacesetter.media.record import record as film
from pacesetter.policy import champions, load
from pacesetter.training.trainer import Trainer

ROOT = Path(__file__).parents[2]
PROBE = "broken_envs:Probe-v0"
CHAMPION = "HalfCheetah-v4-sac"


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Commands run in an empty folder."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def pendulum(here: Path) -> Path:
    file = here / "pendulum.safetensors"
    untrained("Pendulum-v1", step=7, algorithm="td3").save(file)
    return file


def refused(capsys: pytest.CaptureFixture[str], *words: object) -> str:
    """The one line of a command that must be refused."""
    assert main([str(word) for word in words]) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    (line,) = printed.err.splitlines()
    return line


def test_a_policy_by_all_its_names(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A run's folder, its short name and its file mean the same policy."""
    run = run_to_end(Trainer("td3", "Pendulum-v1", runs="runs", steps=150, **TINY))
    expected = evaluate(load(run.policy_file), "Pendulum-v1", 2, 5).returns
    for word in (run.path, "Pendulum-v1/td3/0", "td3/0", run.policy_file):
        assert main(["eval", str(word), "--episodes", "2", "--seed", "5", "--json"]) == 0
        assert json.loads(capsys.readouterr().out)["returns"] == expected


def test_champions_are_listed_and_loaded(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["list", "champions"]) == 0
    assert f"champion:{CHAMPION}" in capsys.readouterr().out
    assert main(["eval", f"champion:{CHAMPION}", "--episodes", "1", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["mean"] > 5_000
    assert load(found["policy"]).about["algorithm"] == "sac"
    assert CHAMPION in refused(capsys, "eval", "champion:HalfCheetah-v4-td3")


def test_show_tells_what_a_policy_file_says_of_itself(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A shipped champion, and a file beside; a bad name and no file are refused in a line."""
    assert main(["show", f"champion:{CHAMPION}", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["about"]["env"], told["sizes"]) == ("HalfCheetah-v4", [17, 256, 256, 6])
    mine = untrained("Pendulum-v1")
    replace(mine, about=mine.about | {"versions": "odd"}).save(here / "mine.safetensors")
    assert main(["show", "mine.safetensors"]) == 0
    assert re.search(r"^env +Pendulum-v1$", capsys.readouterr().out, re.MULTILINE)
    assert CHAMPION in refused(capsys, "show", "champion:HalfCheetah-v4-td3")
    assert "no such file" in refused(capsys, "show", "none.safetensors")


@pytest.mark.slow
def test_the_wheel_holds_the_champions(tmp_path: Path) -> None:
    """All of them, byte for byte; needs a package index for the build."""
    words = ["pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", str(tmp_path), str(ROOT)]
    subprocess.run([str(ROOT / ".venv/bin" / words[0]), *words[1:]], check=True)
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as packed:
        for name, file in champions().items():
            inside = packed.read(f"pacesetter/champions/{name}.safetensors")
            assert inside == file.read_bytes()


def test_a_file_imports_a_module_only_where_it_is_named(
    here: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    untrained(PROBE).save(here / "probe.safetensors")
    with monkeypatch.context() as patch:
        patch.delitem(sys.modules, "broken_envs")  # as in a new process
        for verb in (["eval"], ["record"], ["poster"], ["export", "--to", "minari", "-o", "a-v0"]):
            line = refused(capsys, *verb, "probe.safetensors")
            assert f"allow it with --allow {PROBE}" in line, verb
    assert main(["eval", "probe.safetensors", "--episodes", "1", "--env", PROBE]) == 0


def test_a_run_without_a_policy_says_so(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = run_to_end(Trainer("td3", "Pendulum-v1", runs="runs", steps=150, **TINY))
    run.policy_file.unlink()
    assert "no policy yet" in refused(capsys, "record", "td3/0")


@pytest.mark.usefixtures("gl")
def test_record_and_poster(capsys: pytest.CaptureFixture[str]) -> None:
    """What is written has the size, the number of frames and the camera that were asked for."""
    from PIL import Image

    name, view = f"champion:{CHAMPION}", ["--size", "64x48"]
    assert main(["record", name, "-o", "a.gif", "--frames", "3", *view]) == 0
    assert main(["record", name, "-o", "b.gif", "--frames", "3", *view, "--camera", "free"]) == 0
    assert "a.gif: 3 frames, 0.1 s; no episode ended" in capsys.readouterr().out
    with Image.open("a.gif") as one, Image.open("b.gif") as other:
        assert one.size == other.size == (64, 48)
        assert (one.n_frames, other.n_frames) == (3, 3)
        assert np.any(np.asarray(one.convert("RGB")) != np.asarray(other.convert("RGB")))
    assert main(["poster", name, "-o", "a.png", "--frames", "2", "--cycle", *view]) == 0
    first, second = map(int, capsys.readouterr().out.split("steps ")[1].split(","))
    assert 0 < second - first < 20  # it gallops
    with Image.open("a.png") as strip:
        assert strip.width == 2 * 64 + 6


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["record", "-o", "x.avi"], ".mp4 or .gif"),
        (["record", "--size", "big"], "write 640x480"),
        (["record", "--size", "63x48"], "must be even"),
        (["record", "--frames", "0"], "at least 1"),
        (["record", "--seed", "-1"], "at least 0"),
        (["record", "--camera", "top"], "leave it out"),
        (["poster", "-o", "x.jpg"], "must end in .png"),
        (["export", "--to", "onnyx", "-o", "x"], "did you mean onnx"),
        (["export", "--to", "minari", "-o", "data"], "cheetah-v0"),
        (["watch", "--no-browser"], "pacesetter record"),
    ],
)
def test_refusals(
    words: list[str],
    said: str,
    pendulum: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    assert said in refused(capsys, words[0], pendulum, *words[1:])
    assert [path.name for path in pendulum.parent.iterdir()] == [pendulum.name]


def test_export_to_sb3(pendulum: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["export", str(pendulum), "--to", "sb3", "-o", "swing.py"]) == 0
    assert "swing.py" in capsys.readouterr().out
    model: Any = runpy.run_path("swing.py")["model"]
    seen = np.array([0.5, -0.5, 1.0], np.float32)
    assert np.array_equal(model.predict(seen)[0], load(pendulum)(seen))


def test_record_hands_over_what_was_typed(
    pendulum: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    double = create_autospec(film, return_value=Film(12, 4.0, [-1.0, -2.0]))
    monkeypatch.setattr(film_module, "record", double)
    flags = ["-o", "a.gif", "--episodes", "2", "--frames", "30", "--size", "64x48", "--no-text"]
    assert main(["record", str(pendulum), *flags, "--seed", "5"]) == 0
    assert capsys.readouterr().out == "a.gif: 12 frames, 3.0 s; return -1.0, -2.0\n"
    (_, path), how = double.call_args
    expected = {"episodes": 2, "frames": 30, "size": (64, 48), "text": False, "seed": 5}
    assert (path, {key: how[key] for key in expected}) == ("a.gif", expected)


def test_push_hands_over_what_was_typed(
    pendulum: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    double = create_autospec(hub.push, return_value="https://there")
    monkeypatch.setattr(hub, "push", double)
    flags = ["--video", "a.mp4", "--private", "--episodes", "3", "--seed", "2"]
    assert main(["push", str(pendulum), "me/swing", *flags]) == 0
    assert capsys.readouterr().out == "https://there\n"
    how = {"video": "a.mp4", "private": True, "episodes": 3, "seed": 2, "env": None}
    how["env_kwargs"] = load(pendulum).about.get("env_kwargs", {})
    double.assert_called_once_with(pendulum, "me/swing", **how)


def test_fetch_keeps_what_it_loads(
    pendulum: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The file acts as the one on the hub; one that is here already is not overwritten."""
    double = create_autospec(hub.load_from_hub, return_value=load(pendulum))
    monkeypatch.setattr(hub, "load_from_hub", double)
    assert main(["fetch", "me/swing", "--revision", "main"]) == 0
    double.assert_called_once_with("me/swing", "policy.safetensors", revision="main")
    assert "swing.safetensors: td3 on Pendulum-v1, step 7" in capsys.readouterr().out
    seen = np.ones((4, 3), np.float32)
    assert np.array_equal(load("swing.safetensors")(seen), load(pendulum)(seen))
    assert "exists" in refused(capsys, "fetch", "me/swing")
    assert main(["fetch", "me/swing", "-o", "my swing.safetensors"]) == 0
    assert "see `pacesetter eval 'my swing.safetensors'`" in capsys.readouterr().out
    assert "must end in" in refused(capsys, "fetch", "me/swing", "-o", "swing.zip")
    assert double.call_count == 2


def test_watch_hands_over_what_was_typed(pendulum: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from pacesetter.media import watch

    double = create_autospec(watch.watch)
    monkeypatch.setattr(watch, "watch", double)
    assert main(["watch", str(pendulum), "--browser", "--port", "9", "--seed", "4"]) == 0
    how = SimpleNamespace(**double.call_args.kwargs)
    assert (how.browser, how.port, how.seed, how.episodes, how.env) == (True, 9, 4, None, None)
