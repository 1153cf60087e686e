"""A film of a policy at its task, drawn without a display."""

import importlib
import os
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pacesetter.envs import Environment
from pacesetter.errors import UsageError
from pacesetter.evaluation import enter
from pacesetter.policy import Policy

Frame = NDArray[np.uint8]
INSTALL = "apt-get install -y --no-install-recommends libegl1 libgl1"
SUFFIXES = (".mp4", ".gif")


def record(
    policy: Policy,
    path: str | Path,
    *,
    env: str | None = None,
    frames: int = 200,
    size: tuple[int, int] = (320, 240),
    seed: int = 0,
) -> int:
    """Film seeded episodes, one after another, at the env's own pace; returns the frames written.

    `size` is that of MuJoCo tasks; others draw in a size of their own.
    """
    path = Path(path)
    _check(path, frames, size)
    with _gl():
        world = enter(policy, env, seed, render_mode="rgb_array")
        try:
            _aim(world, size)
            rate = float(world.env.metadata.get("render_fps") or 30)
            return _write(path, _film(policy, world, frames), rate)
        finally:
            _leave(world)


def _check(path: Path, frames: int, size: tuple[int, int]) -> None:
    if path.suffix not in SUFFIXES:
        raise UsageError(f"video: {path} must end in {' or '.join(SUFFIXES)}")
    if frames < 1:
        raise UsageError(f"frames: must be at least 1, got {frames}")
    # yuv420p, which every player shows, stores colour for two by two pixels.
    if min(size) < 2 or any(side % 2 for side in size):
        raise UsageError(f"size: both sides must be even, got {size[0]}x{size[1]}")


@contextmanager
def _gl() -> Generator[None]:
    """Let MuJoCo draw by EGL where no display is, and only in here.

    MuJoCo comes first: with MUJOCO_GL=egl and no EGL it could never be imported again.
    """
    try:
        import mujoco  # noqa: F401  # pyright: ignore[reportUnusedImport]
    except Exception:
        raise _no_gl() from None
    chosen = os.environ.get("MUJOCO_GL")
    with _setting("MUJOCO_GL", chosen if chosen or os.environ.get("DISPLAY") else "egl"):
        yield


@contextmanager
def _setting(name: str, value: str | None) -> Generator[None]:
    """An environment variable for a while, for libraries that are told things only so."""
    before = os.environ.get(name)
    try:
        if value is not None:
            os.environ[name] = value
        yield
    finally:
        os.environ.pop(name, None)
        if before is not None:
            os.environ[name] = before


def _no_gl() -> UsageError:
    backend = os.environ.get("MUJOCO_GL", "unset")
    return UsageError(
        f"video: no OpenGL to draw with (MUJOCO_GL={backend}); MUJOCO_GL=egl needs `{INSTALL}`"
    )


def _aim(world: Environment, size: tuple[int, int]) -> None:
    """Set MuJoCo's size and the camera that follows the walker; by default it would walk away."""
    import mujoco

    if not _is_mujoco(world):
        return
    _try_gl()
    library: Any = mujoco
    task: Any = world.env.unwrapped
    model, renderer = task.model, task.mujoco_renderer
    renderer.width, renderer.height = size
    model.vis.global_.offwidth = max(model.vis.global_.offwidth, size[0])
    model.vis.global_.offheight = max(model.vis.global_.offheight, size[1])
    if renderer.camera_id == -1:
        renderer.camera_id = library.mj_name2id(model, library.mjtObj.mjOBJ_CAMERA, "track")


def _is_mujoco(world: Environment) -> bool:
    from gymnasium.envs.mujoco import MujocoEnv

    return isinstance(world.env.unwrapped, MujocoEnv)


def _leave(world: Environment) -> None:
    """Close the env; MuJoCo's picture buffers first.

    Garbage collection would free them by number in whatever film is drawn then, and blacken it.
    """
    task: Any = world.env.unwrapped
    if _is_mujoco(world) and (viewer := task.mujoco_renderer.viewer) is not None:
        viewer.make_context_current()
        viewer.con.free()
    world.close()


def _try_gl() -> None:
    """Fail here rather than in Gymnasium, which prints a traceback when it frees what failed."""
    backend = os.environ.get("MUJOCO_GL")
    if backend not in ("egl", "osmesa"):
        return
    try:
        importlib.import_module(f"mujoco.{backend}").GLContext(1, 1).free()
    except Exception:
        raise _no_gl() from None


def _film(policy: Policy, world: Environment, frames: int) -> Iterator[Frame]:
    observation = world.reset()
    for _ in range(frames):
        yield _draw(world)
        step = world.step(policy.act(observation))
        observation = world.reset() if step.ended else step.observation


def _draw(world: Environment) -> Frame:
    try:
        frame: Any = world.env.render()
    except Exception as error:
        if _is_mujoco(world):
            raise _no_gl() from None
        raise UsageError(f"env: {world.name} cannot be drawn: {error}") from None
    if not isinstance(frame, np.ndarray) or frame.ndim != 3 or frame.dtype != np.uint8:
        raise UsageError(f"env: {world.name} gives no picture in the mode rgb_array")
    return frame


def _write(path: Path, film: Iterator[Frame], rate: float) -> int:
    import imageio.v2

    library: Any = imageio.v2
    first = next(film)  # so that no file is made where nothing can be drawn
    written = 0
    try:
        path.open("wb").close()  # a refusal comes as one line here, from ffmpeg as many
        # Otherwise ffmpeg is started by a plain fork, which JAX's threads make unsafe.
        with (
            _setting("IMAGEIO_FFMPEG_NO_PREVENT_SIGINT", "1"),
            library.get_writer(path, **_options(path.suffix, rate)) as writer,
        ):
            for frame in chain([first], film):
                writer.append_data(frame)
                written += 1
    except OSError as error:
        reason = error.strerror or str(error).splitlines()[0]
        raise UsageError(f"video: cannot write {path}: {reason}") from None
    return written


def _options(suffix: str, rate: float) -> dict[str, Any]:
    if suffix == ".gif":
        # Hundredths of a second are all a GIF knows, and below two of them viewers play it at ten.
        return {"mode": "I", "duration": max(20, round(100 / rate) * 10), "loop": 0}
    return {
        "format": "FFMPEG",
        "fps": rate,
        "codec": "libx264",
        "pixelformat": "yuv420p",
        "macro_block_size": 2,
    }
