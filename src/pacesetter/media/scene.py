"""A policy's task ready to be drawn without a display: OpenGL, size and camera."""

import importlib
import os
import sys
from collections.abc import Generator
from contextlib import closing, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pacesetter.envs import Environment, Recipe
from pacesetter.errors import UsageError, unknown
from pacesetter.evaluation import enter
from pacesetter.policy import Policy
from pacesetter.seeding import Stream

Frame = NDArray[np.uint8]
INSTALL = "apt-get install -y --no-install-recommends libegl1 libgl1"
SHADOW = 1024  # pixels of a side of the shadow map
HAZE = 0.36, 0.40, 0.37  # of a far checkered floor; white would draw a line at the horizon
FOLLOW, FREE = "track", "free"  # the name of MuJoCo's own models; what Gymnasium would show


class Stage(Environment):
    """A task that is drawn with a size and a camera of MuJoCo's, also when it is made anew."""

    def __init__(
        self,
        recipe: Recipe,
        seed: int,
        stream: Stream,
        *,
        size: tuple[int, int],
        camera: str | None,
    ) -> None:
        super().__init__(recipe, seed, stream)
        self.size, self.camera = size, camera

    def renew(self, episode: int) -> None:
        super().renew(episode)
        aim(self, self.size, self.camera)

    def close(self) -> None:
        """Close the env; MuJoCo's picture buffers first.

        Garbage collection would free them by number in whatever film is drawn then, and blacken it.
        """
        task: Any = self.env.unwrapped
        if is_mujoco(self) and (viewer := task.mujoco_renderer.viewer) is not None:
            viewer.make_context_current()
            viewer.con.free()
        super().close()


@contextmanager
def scene(
    policy: Policy,
    env: str | Recipe | None,
    env_kwargs: dict[str, Any] | None,
    seed: int,
    size: tuple[int, int],
    camera: str | None,
) -> Generator[Stage]:
    """The task in the mode rgb_array; without EGL or with an unknown camera, a UsageError."""
    stage = partial(Stage, size=size, camera=camera)
    with gl(), closing(enter(policy, env, seed, env_kwargs, stage, render_mode="rgb_array")) as one:
        aim(one, size, camera)
        yield one


def check_size(size: tuple[int, int]) -> None:
    """Refuse what no film can have: yuv420p stores colour for two by two pixels."""
    if min(size) < 2 or any(side % 2 for side in size):
        raise UsageError(f"size: both sides must be even, got {size[0]}x{size[1]}")


def check_folder(what: str, path: Path) -> None:
    """Refuse a file in a folder that is not there, before anything is computed for it."""
    if not path.parent.is_dir():
        raise UsageError(f"{what}: cannot write {path}: No such file or directory")


@contextmanager
def gl() -> Generator[None]:
    """Let MuJoCo draw by EGL on a Linux without a display, and only in here.

    MuJoCo comes first: with MUJOCO_GL=egl and no EGL it could never be imported again.
    """
    try:
        import mujoco  # noqa: F401  # pyright: ignore[reportUnusedImport]
    except Exception:
        raise _no_gl() from None
    chosen = os.environ.get("MUJOCO_GL")
    by_egl = not chosen and sys.platform == "linux" and not os.environ.get("DISPLAY")
    with setting("MUJOCO_GL", "egl" if by_egl else chosen):
        yield


@contextmanager
def setting(name: str, value: str | None) -> Generator[None]:
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
    linux = f"; MUJOCO_GL=egl needs `{INSTALL}`" if sys.platform == "linux" else ""
    return UsageError(f"video: no OpenGL to draw with (MUJOCO_GL={backend}){linux}")


def is_mujoco(world: Environment) -> bool:
    from gymnasium.envs.mujoco import MujocoEnv

    return isinstance(world.env.unwrapped, MujocoEnv)


def cameras(world: Environment) -> list[str]:
    """Names that `camera` may have: the model's own and `free`; none but for MuJoCo."""
    if not is_mujoco(world):
        return []
    import mujoco

    task: Any = world.env.unwrapped
    library: Any = mujoco
    kind = library.mjtObj.mjOBJ_CAMERA
    named = (library.mj_id2name(task.model, kind, n) for n in range(task.model.ncam))
    return [FREE, *(name for name in named if name)]


def aim(world: Environment, size: tuple[int, int], camera: str | None = None) -> None:
    """Set MuJoCo's size and camera, by default the one that follows the walker."""
    names = cameras(world)
    if camera is not None and camera not in names:
        if not names:
            raise UsageError(f"camera: {world.name} has none to choose; leave it out")
        raise unknown("camera", camera, names)
    if not names:
        return
    _try_gl()
    task: Any = world.env.unwrapped
    model, renderer = task.model, task.mujoco_renderer
    renderer.width, renderer.height = size
    model.vis.global_.offwidth = max(model.vis.global_.offwidth, size[0])
    model.vis.global_.offheight = max(model.vis.global_.offheight, size[1])
    # Without a graphics card most of a frame's time goes into the shadow's 4096 by 4096 pixels.
    model.vis.quality.shadowsize = min(model.vis.quality.shadowsize, SHADOW)
    lay_floor(model)
    if camera == FREE:
        renderer.camera_id = -1
    elif camera is not None or renderer.camera_id == -1:
        renderer.camera_id = camera_number(world, camera or FOLLOW)  # a still one would lose it


def camera_number(world: Environment, name: str) -> int:
    """The number of a MuJoCo model's camera; -1, the free one, if it has none of this name."""
    import mujoco

    library: Any = mujoco
    task: Any = world.env.unwrapped
    return library.mj_name2id(task.model, library.mjtObj.mjOBJ_CAMERA, name)


def lay_floor(model: Any) -> None:
    """Draw patterned floors without end; quick walkers leave the part that is drawn of them."""
    import mujoco

    library: Any = mujoco
    model.vis.rgba.haze[:3] = HAZE
    for plane in np.flatnonzero(model.geom_type == library.mjtGeom.mjGEOM_PLANE):
        material, size = model.geom_matid[plane], model.geom_size[plane, :2].copy()
        if material >= 0 and size.all():
            model.geom_size[plane, :2] = 0  # which is drawn as endless; contacts never read it
            if not model.mat_texuniform[material]:
                # Squares are counted over half the floor, and where that has no end, over a metre.
                model.mat_texrepeat[material] /= size


def _try_gl() -> None:
    """Fail here rather than in Gymnasium, which prints a traceback when it frees what failed."""
    backend = os.environ.get("MUJOCO_GL")
    if backend not in ("egl", "osmesa"):
        return
    try:
        importlib.import_module(f"mujoco.{backend}").GLContext(1, 1).free()
    except Exception:
        raise _no_gl() from None


def draw(world: Environment) -> Frame:
    """The picture (height, width, 3) of where the task is now."""
    try:
        frame: Any = world.env.render()
    except Exception as error:
        if is_mujoco(world):
            raise _no_gl() from None
        raise UsageError(f"env: {world.name} cannot be drawn: {error}") from None
    if not isinstance(frame, np.ndarray) or frame.ndim != 3 or frame.dtype != np.uint8:
        raise UsageError(f"env: {world.name} gives no picture in the mode rgb_array")
    return frame
