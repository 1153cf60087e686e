"""A policy at its task, live: in a window, or on a page for the browser of this machine."""

import os
import signal
import sys
from contextlib import closing
from dataclasses import replace
from importlib.util import find_spec
from itertools import count
from time import perf_counter, sleep
from typing import Any

from pacesetter.envs import Environment, Recipe
from pacesetter.errors import UsageError
from pacesetter.evaluation import enter, recipe_of
from pacesetter.extras import need
from pacesetter.media.scene import FOLLOW, camera_number, is_mujoco, lay_floor
from pacesetter.policy import Policy
from pacesetter.types import Floats

INSTALL = "pacesetter[watch]"
DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY")
FILM = "make a film with `pacesetter record`"
DISTANCE = 4.0  # metres from the walker where the task names none
HOST = "127.0.0.1"  # viser's own default would show the page to the whole network


def watch(
    policy: Policy,
    *,
    browser: bool | None = None,
    episodes: int | None = None,
    port: int = 8080,
    env: str | Recipe | None = None,
    env_kwargs: dict[str, Any] | None = None,
    seed: int = 0,
) -> None:
    """Show seeded episodes at the env's own pace until Ctrl-C, or `episodes` of them in a window.

    Opens a window where there is a display, else a page at http://127.0.0.1:port if mjviser is
    installed; `browser` chooses. With neither, one line that points to `record`.
    """
    if episodes is not None and episodes < 1:
        raise UsageError(f"episodes: must be at least 1, got {episodes}")
    if not 0 < port < 2**16:
        raise UsageError(f"port: must be from 1 to 65535, got {port}")
    page = _wants_page(browser)
    task = recipe_of(policy.about, env, env_kwargs)
    try:
        if page:  # which goes on showing the model that it began with
            with closing(enter(policy, replace(task, renew=False), seed)) as world:
                _page(policy, world, port)
        else:
            with closing(enter(policy, task, seed, None, Window, render_mode="human")) as world:
                _window(policy, world, episodes)
    except KeyboardInterrupt as end:  # Ctrl-C is how it is meant to end; other signals are not
        if end.args not in ((), (signal.SIGINT,)):
            raise


def _wants_page(browser: bool | None) -> bool:
    """Whether to show a page rather than a window, or one line if neither can be."""
    display = sys.platform == "darwin" or any(os.environ.get(name) for name in DISPLAYS)
    if display and not browser:
        return False
    if browser is False:
        raise UsageError(f"watch: no display for a window (DISPLAY is not set); {FILM}")
    if find_spec("mjviser") is None:
        what = "no mjviser" if display else "no display for a window and no mjviser"
        raise UsageError(f"watch: {what} for a page; pip install '{INSTALL}', or {FILM}")
    return True


class Window(Environment):
    """A task in a window whose camera follows the walker, also when it is made anew."""

    def reset(self, episode: int | None = None) -> Floats:
        before = None if self.new else self.env
        observation = super().reset(episode)
        if is_mujoco(self) and self.env is not before:
            _follow(self)
        return observation


def _window(policy: Policy, world: Environment, episodes: int | None) -> None:
    """Gymnasium draws at each step; MuJoCo's windows do not wait for the clock, so this does."""
    pace = float(world.env.metadata.get("render_fps") or 0) if is_mujoco(world) else 0.0
    for _ in count() if episodes is None else range(episodes):
        observation, ended, began = world.reset(), False, perf_counter()
        while not ended:
            step = world.step(policy.act(observation))
            observation, ended = step.observation, step.ended
            if pace:
                sleep(max(0.0, began + len(world.actions) / pace - perf_counter()))


def _follow(world: Environment) -> None:
    """Fix the open window's camera to the walker, as Tab does in it."""
    import mujoco

    library: Any = mujoco
    task: Any = world.env.unwrapped
    lay_floor(task.model)
    if (camera := camera_number(world, FOLLOW)) != -1:
        view = task.mujoco_renderer.viewer.cam
        view.type, view.fixedcamid = library.mjtCamera.mjCAMERA_FIXED, camera


def _page(policy: Policy, world: Environment, port: int) -> None:
    """Serve until Ctrl-C; mjviser calls for each of the simulator's steps, at the clock's pace."""
    if not is_mujoco(world):
        raise UsageError(f"watch: a page shows MuJoCo tasks, {world.name} is none; {FILM}")
    viser, mjviser = (need("watch", name, INSTALL) for name in ("viser", "mjviser"))
    task: Any = world.env.unwrapped
    near = (task.mujoco_renderer.default_cam_config or {}).get("distance", DISTANCE)
    task.model.stat.extent = near / 3  # mjviser begins three of them away
    world.reset()
    calls = count(1)

    def step(*_: Any) -> None:
        if next(calls) % task.frame_skip == 0 and world.step(policy.act(world.observation)).ended:
            world.reset()

    server = viser.ViserServer(host=HOST, port=port, label=world.name)
    mjviser.Viewer(
        task.model, task.data, step_fn=step, reset_fn=lambda *_: world.reset(), server=server
    ).run()
