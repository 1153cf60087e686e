"""Films and curves: what is written can be read back, and what is missing is said in one line."""

import gc
import json
import os
import subprocess
import sys
import warnings
from itertools import count
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from matplotlib.figure import Figure
from policies import untrained

from pacesetter.envs import Environment
from pacesetter.errors import TaskError, UsageError
from pacesetter.evaluation import evaluate
from pacesetter.media.caption import caption
from pacesetter.media.curve import curve
from pacesetter.media.record import duration, record
from pacesetter.media.scene import INSTALL, draw, gl, scene
from pacesetter.policy import Policy
from pacesetter.runs import RunDirectory

TOLD = ("MUJOCO_GL", "IMAGEIO_FFMPEG_NO_PREVENT_SIGINT")


def frames_of(path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[list[Any], dict[str, Any]]:
    """All frames of a film and what its header says."""
    import imageio.v2

    # ffmpeg would be started by a fork, of which JAX warns.
    monkeypatch.setenv("IMAGEIO_FFMPEG_NO_PREVENT_SIGINT", "1")
    library: Any = imageio.v2
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ResourceWarning)  # imageio's reader leaves its pipes open
        with library.get_reader(path) as reader:
            found = [np.array(frame) for frame in reader], reader.get_meta_data()
        del reader
        gc.collect()
    return found


@pytest.mark.usefixtures("gl")
def test_mp4_has_the_frames_size_and_pace_of_the_task(
    cheetah: Policy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    jax.devices()  # its threads make every plain fork a warning, so an error here
    before = {name: os.environ.get(name) for name in TOLD}
    film = record(cheetah, tmp_path / "film.mp4", frames=10, size=(320, 240))
    assert film == (10, 20.0, [])
    assert {name: os.environ.get(name) for name in TOLD} == before
    frames, about = frames_of(tmp_path / "film.mp4", monkeypatch)
    assert [frame.shape for frame in frames] == [(240, 320, 3)] * 10
    assert about["fps"] == 20
    assert about["codec"] == "h264"
    assert about["pix_fmt"].startswith("yuv420p")
    assert not np.array_equal(frames[0], frames[-1])


@pytest.mark.usefixtures("gl")
def test_gif_of_another_version_of_the_task(
    cheetah: Policy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "film.gif"
    assert record(cheetah, path, env="HalfCheetah-v4", frames=5, size=(64, 48)).frames == 5
    frames, about = frames_of(path, monkeypatch)
    assert [frame.shape[:2] for frame in frames] == [(48, 64)] * 5
    assert about["duration"] == 50


@pytest.mark.usefixtures("gl")
def test_episodes_that_end_early_start_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    entered: list[int] = []
    reset = Environment.reset

    def count(world: Environment, episode: int | None = None) -> Any:
        observation = reset(world, episode)
        entered.append(world.episode)
        return observation

    monkeypatch.setattr(Environment, "reset", count)
    pendulum = untrained("InvertedPendulum-v5")
    assert record(pendulum, tmp_path / "falls.mp4", frames=60, size=(64, 48)).frames == 60
    assert len(frames_of(tmp_path / "falls.mp4", monkeypatch)[0]) == 60
    assert entered[1:4] == [0, 1, 2]  # the first entry of all is the check


@pytest.mark.usefixtures("gl")
def test_camera_follows_the_walker_far_from_the_start(cheetah: Policy) -> None:
    with scene(cheetah, None, None, 0, (320, 240), None) as world:
        world.reset(0)
        task: Any = world.env.unwrapped
        near = draw(world)
        task.data.qpos[0] += 30.0
        task.set_state(task.data.qpos, task.data.qvel)
        far = draw(world)
    # The cheetah is the only thing with more red than blue.
    columns = [np.nonzero(frame[..., 0] > frame[..., 2] + 40.0)[1] for frame in (near, far)]
    assert columns[0].size > 500
    assert columns[1].size > 500
    assert columns[1].mean() == pytest.approx(columns[0].mean(), abs=10)


@pytest.mark.usefixtures("gl")
def test_a_task_that_is_made_anew_is_filmed_alike(
    cheetah: Policy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Size, camera and floor are those of a task that is kept."""
    films: list[list[Any]] = []
    for renew in (False, True):
        cheetah.about["renew_env"] = renew
        path = tmp_path / f"{renew}.gif"
        kwargs = {"max_episode_steps": 3}
        record(cheetah, path, episodes=2, size=(64, 48), env_kwargs=kwargs, text=False)
        films.append(frames_of(path, monkeypatch)[0])
    kept, renewed = films
    assert kept[0].shape[:2] == (48, 64)
    assert len(kept) == len(renewed)
    for one, other in zip(kept, renewed, strict=True):
        assert one.shape == other.shape
        # Of 256: a used renderer's first frame differs by 3, and a palette makes more of that.
        assert np.abs(one.astype(int) - other).mean() < 1


@pytest.mark.parametrize("rate", [20.0, 30.0, 125 / 3, 50.0])
def test_frames_of_a_gif_add_up_to_its_time(rate: float) -> None:
    durations = [duration(number, rate) for number in range(200)]
    assert min(durations) >= 20
    assert abs(sum(durations) - 1000 * 200 / rate) <= 10


@pytest.mark.usefixtures("gl")
def test_an_old_film_that_is_freed_late_leaves_a_new_one_alone(
    cheetah: Policy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from pacesetter.media import record as film
    from pacesetter.media import scene as stage

    kept: list[Any] = []
    close, draw = stage.Stage.close, stage.draw

    def close_and_keep(world: Any) -> None:
        kept.append(world.env.unwrapped)
        close(world)

    def draw_and_forget(world: Any) -> Any:
        frame = draw(world)
        kept.clear()
        return frame

    monkeypatch.setattr(stage.Stage, "close", close_and_keep)
    record(cheetah, tmp_path / "old.gif", frames=2, size=(32, 32))
    monkeypatch.setattr(film, "draw", draw_and_forget)
    record(cheetah, tmp_path / "new.mp4", frames=4, size=(320, 240))
    frames, _ = frames_of(tmp_path / "new.mp4", monkeypatch)
    assert min(frame.mean() for frame in frames) > 50


def test_missing_gl_is_one_line_that_says_what_to_install(
    cheetah: Policy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MUJOCO_GL", "egl")
    monkeypatch.setitem(sys.modules, "mujoco.egl", None)
    with pytest.raises(UsageError, match="libegl1 libgl1") as caught:
        record(cheetah, tmp_path / "film.mp4")
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "film.mp4").exists()


@pytest.mark.parametrize(
    ("system", "display", "told", "drawn_by"),
    [
        ("linux", None, None, "egl"),
        ("linux", ":0", None, None),
        ("linux", None, "osmesa", "osmesa"),
        ("darwin", None, None, None),
    ],
)
def test_egl_is_for_a_linux_without_display(
    system: str,
    display: str | None,
    told: str | None,
    drawn_by: str | None,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sys, "platform", system)
    for name, value in (("DISPLAY", display), ("MUJOCO_GL", told)):
        monkeypatch.delenv(name, raising=False)
        if value:
            monkeypatch.setenv(name, value)
    with gl():
        assert os.environ.get("MUJOCO_GL") == drawn_by
    assert os.environ.get("MUJOCO_GL") == told


def test_mujoco_that_cannot_even_be_imported_is_the_same_line(tmp_path: Path) -> None:
    code = """
import sys
import numpy as np
from pacesetter.errors import TaskError, UsageError
from pacesetter.media.record import record
from pacesetter.policy import Policy
one = np.ones((1, 1), np.float32)
policy = Policy([[{"kernel": one, "bias": one[0]}]], "relu", "tanh", -one[0], one[0])
try:
    record(policy, sys.argv[1], env="HalfCheetah-v5")
except UsageError as error:
    print(error)
"""
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "film.mp4")],
        env={**os.environ, "MUJOCO_GL": "bogus"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.count("\n") == 1
    assert INSTALL in done.stdout
    assert done.stderr == ""


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"path": "film.avi"}, r"\.mp4 or \.gif"),
        ({"frames": 0}, "frames: must be at least 1"),
        ({"episodes": 0}, "episodes: must be at least 1, got 0"),
        ({"camera": "trak"}, "camera: unknown 'trak'; did you mean track"),
        ({"camera": "roof"}, "camera: unknown 'roof'; allowed: free, track"),
        ({"env": "Pendulum-v1", "camera": "track"}, "observations of 3"),
        ({"size": (321, 240)}, "size: both sides must be even"),
        ({"env": "Hopper-v5"}, "observations of 11"),
        ({"env": "HalfCheetah-v77"}, "unknown 'HalfCheetah-v77'"),
    ],
)
def test_bad_input_is_one_line(
    cheetah: Policy, tmp_path: Path, settings: dict[str, Any], said: str
) -> None:
    path = tmp_path / settings.get("path", "film.mp4")
    rest = {key: value for key, value in settings.items() if key != "path"}
    with pytest.raises(UsageError, match=said):
        record(cheetah, path, **rest)
    assert not path.exists()


def test_a_folder_that_is_not_there_is_one_line(cheetah: Policy, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="No such file"):
        record(cheetah, tmp_path / "none" / "film.mp4", frames=1)


def short(**about: Any) -> Policy:
    """A cheetah whose episodes end after seven steps."""
    return untrained("HalfCheetah-v5", env_kwargs={"max_episode_steps": 7}, **about)


@pytest.mark.usefixtures("gl")
def test_one_episode_by_default_and_drawing_changes_no_return(tmp_path: Path) -> None:
    film = record(short(), tmp_path / "film.gif", size=(64, 48), seed=5)
    assert film == (8, 20.0, evaluate(short(), episodes=1, seed=5).returns)
    two = record(short(), tmp_path / "two.gif", size=(64, 48), seed=5, episodes=2)
    assert two == (16, 20.0, evaluate(short(), episodes=2, seed=5).returns)
    cut = record(short(), tmp_path / "cut.gif", size=(64, 48), seed=5, episodes=2, frames=9)
    assert cut == (9, 20.0, two.returns[:1])


@pytest.mark.usefixtures("gl")
@pytest.mark.parametrize("suffix", ["mp4", "gif"])
def test_a_film_that_fails_leaves_the_one_before(
    suffix: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A task that breaks down in its fifth step costs no film of yesterday, and leaves no part."""
    (tmp_path / "probe.gif").unlink()
    film, step, steps = tmp_path / f"film.{suffix}", Environment.step, count()
    film.write_bytes(b"of yesterday")

    def fail(self: Environment, action: Any) -> Any:
        if next(steps) == 4:
            raise TaskError("a bolt fell out")
        return step(self, action)

    monkeypatch.setattr(Environment, "step", fail)
    with pytest.raises(TaskError, match="bolt"):
        record(short(), film, size=(64, 48))
    assert [(path.name, path.read_bytes()) for path in tmp_path.iterdir()] == [
        (film.name, b"of yesterday")
    ]


@pytest.mark.usefixtures("gl")
def test_a_quick_task_keeps_its_pace_with_fewer_frames(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hopper = untrained("Hopper-v5", env_kwargs={"max_episode_steps": 7})  # 125 steps a second
    path = tmp_path / "film.mp4"
    film = record(hopper, path, size=(64, 48))
    assert (film.frames, film.rate) == (4, pytest.approx(125 / 3))  # steps 0, 3, 6 and 7
    assert frames_of(path, monkeypatch)[1]["fps"] == pytest.approx(125 / 3, abs=0.01)


@pytest.mark.usefixtures("gl")
def test_step_and_return_stand_in_the_frame_and_can_be_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[str] = []

    def remember(frame: Any, text: str) -> Any:
        said.append(text)
        return caption(frame, text)

    monkeypatch.setattr("pacesetter.media.record.caption", remember)
    film = record(short(), tmp_path / "film.gif", size=(320, 240))
    assert said[0] == "step 0   return 0.0"
    assert said[-1] == f"step 7   return {film.returns[0]:,.1f}"
    record(short(), tmp_path / "bare.gif", size=(320, 240), text=False)
    assert len(said) == film.frames
    with_text, bare = (
        frames_of(tmp_path / f"{name}.gif", monkeypatch)[0][0][..., :3] for name in ("film", "bare")
    )
    apart = np.abs(with_text.astype(int) - bare).max(axis=-1) > 40
    assert apart[:40, :160].mean() > 0.2
    assert apart[60:].mean() < 0.01


@pytest.mark.usefixtures("gl")
def test_cameras_differ_and_the_floor_has_no_end(cheetah: Policy) -> None:
    pictures = {}
    for camera in ("track", "free", None):
        with scene(cheetah, None, None, 0, (64, 48), camera) as world:
            world.reset(0)
            pictures[camera] = draw(world)
            task: Any = world.env.unwrapped
            task.data.qpos[0] += 300.0
            task.set_state(task.data.qpos, task.data.qvel)
            far = draw(world)
    assert np.array_equal(pictures["track"], pictures[None])
    assert not np.array_equal(pictures["track"], pictures["free"])
    assert far[40:].min() < 20  # a black square
    assert far[40:].max() > 120  # a light one


def test_a_file_cannot_make_its_reader_import_a_module(tmp_path: Path) -> None:
    policy = untrained("HalfCheetah-v5")
    policy.about["env"] = "antigravity:HalfCheetah-v5"
    with pytest.raises(UsageError, match="allow it with --allow"):
        record(policy, tmp_path / "film.mp4")


def handmade(folder: Path, rows: list[dict[str, Any]]) -> RunDirectory:
    """A run of only a config and a log."""
    folder.mkdir()
    settings = {"algorithm": "td3", "env": "HalfCheetah-v5", "name": "tiny", "seed": 4}
    settings |= {"steps": 2000, "eval_every": 1000}
    (folder / "config.json").write_text(
        json.dumps({"schema": 1, "threads": 2, "settings": settings})
    )
    (folder / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    return RunDirectory(folder)


def evaluation(step: int, *returns: float) -> dict[str, Any]:
    return {"kind": "eval", "step": step, "returns": returns, "mean": float(np.mean(returns))}


@pytest.mark.parametrize("suffix", ["png", "svg"])
def test_curve_draws_evaluations_and_training(tmp_path: Path, suffix: str) -> None:
    rows = [
        evaluation(0, -1.0, -2.0),
        {"kind": "train", "step": 1000, "episodes_ended": [[0, -300.0, 500], [1, -200.0, 500]]},
        {"kind": "select", "step": 1000, "parents": [1, 1]},
        evaluation(2000, 100.0, 300.0),
    ]
    path = tmp_path / f"curve.{suffix}"
    curve(handmade(tmp_path / "run", rows), path)
    if suffix == "svg":
        text = path.read_text()
        for said in ("HalfCheetah-v5, tiny, seed 4", "env steps, all members", "mean of 2"):
            assert said in text
    else:
        import imageio.v3

        library: Any = imageio.v3
        assert library.imread(path).shape[:2] == (540, 960)


def test_curve_needs_an_evaluation_and_a_known_suffix(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no evaluation"):
        curve(handmade(tmp_path / "new", []), tmp_path / "curve.png")
    run = handmade(tmp_path / "run", [evaluation(0, 1.0)])
    with pytest.raises(UsageError, match=r"\.png"):
        curve(run, tmp_path / "curve.walk")
    with pytest.raises(UsageError, match="cannot write"):
        curve(run, tmp_path / "none" / "curve.png")


def test_curve_that_fails_leaves_the_one_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(self: Figure, path: Path, **how: Any) -> None:
        Path(path).write_bytes(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Figure, "savefig", fail)
    file = tmp_path / "curve.png"
    file.write_bytes(b"of yesterday")
    with pytest.raises(UsageError, match="No space"):
        curve(handmade(tmp_path / "run", [evaluation(0, 1.0)]), file)
    assert file.read_bytes() == b"of yesterday"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["curve.png", "run"]
