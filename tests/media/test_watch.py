"""A window where there is a display, a page where mjviser is, else where to find a film."""

import os
import re
import signal
import subprocess
import sys
import urllib.request
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.mujoco import MujocoEnv
from policies import untrained

from pacesetter.errors import UsageError
from pacesetter.media import watch as module
from pacesetter.media.watch import watch
from pacesetter.policy import Policy
from pacesetter.process import Interrupted

CHAMPION = Path(__file__).parents[2] / "champions" / "HalfCheetah-v4-sac.safetensors"


@pytest.fixture
def cheetah() -> Policy:
    return untrained("HalfCheetah-v5")


@pytest.fixture
def bare(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither display nor mjviser."""
    for name in module.DISPLAYS:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(module, "find_spec", lambda name: None)


@pytest.mark.usefixtures("bare")
def test_without_display_and_page_one_line_points_to_record(
    cheetah: Policy, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(UsageError, match=r"no display for a window and no mjviser.*record") as told:
        watch(cheetah)
    assert "\n" not in str(told.value)
    with pytest.raises(UsageError, match=r"DISPLAY is not set.*record"):
        watch(cheetah, browser=False)
    with pytest.raises(UsageError, match="episodes: must be at least 1"):
        watch(cheetah, episodes=0)
    monkeypatch.setenv("DISPLAY", ":0")
    with pytest.raises(
        UsageError, match=r"no mjviser for a page; pip install 'pacesetter\[watch\]'"
    ):
        watch(cheetah, browser=True)


@pytest.mark.usefixtures("bare")
def test_a_mac_has_a_window_without_the_names_of_x11(
    cheetah: Policy, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown: list[Policy] = []
    monkeypatch.setattr(module, "_window", lambda policy, world, episodes: shown.append(policy))
    monkeypatch.setattr(module, "enter", lambda *given, **more: SimpleNamespace(close=list))
    monkeypatch.setattr(sys, "platform", "darwin")
    watch(cheetah)
    assert shown == [cheetah]


@pytest.mark.parametrize("port", [0, -1, 99_999])
def test_a_port_that_there_is_not(cheetah: Policy, port: int) -> None:
    with pytest.raises(UsageError, match=rf"port: must be from 1 to 65535, got {port}"):
        watch(cheetah, browser=True, port=port)


class Shown(gymnasium.Env[Any, Any]):
    """A task of four steps that notes how it is made and stepped."""

    metadata = {"render_modes": ["human"]}  # noqa: RUF012
    observation_space = gymnasium.spaces.Box(-1, 1, (3,), np.float32)
    action_space = gymnasium.spaces.Box(-2, 2, (1,), np.float32)
    notes: list[Any] = []  # noqa: RUF012

    def __init__(self, render_mode: str | None = None) -> None:
        self.render_mode = render_mode
        self.notes.append(render_mode)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        self.time = 0
        self.notes.append("reset")
        return np.zeros(3, np.float32), {}

    def step(self, action: Any) -> Any:
        self.time += 1
        self.notes.append("step")
        return np.zeros(3, np.float32), 1.0, self.time == 4, False, {}


@pytest.mark.usefixtures("bare")
def test_a_window_shows_the_episodes_in_human_mode(monkeypatch: pytest.MonkeyPatch) -> None:
    gymnasium.register("Shown-v0", entry_point=Shown)
    monkeypatch.setenv("DISPLAY", ":0")
    try:
        policy = untrained("Pendulum-v1")
        watch(policy, env="Shown-v0", episodes=2)
        assert Shown.notes == ["human", "reset", "step", *["reset", *["step"] * 4] * 2]

        def stop(self: Shown, action: Any) -> Any:
            if len(Shown.notes) > 30:
                raise KeyboardInterrupt
            return step(self, action)

        step = Shown.step
        monkeypatch.setattr(Shown, "step", stop)
        watch(policy, env="Shown-v0")  # without end, but for Ctrl-C
        assert len(Shown.notes) > 30
    finally:
        del gymnasium.registry["Shown-v0"]


needs_page = pytest.mark.skipif(find_spec("mjviser") is None, reason="needs mjviser")


@needs_page
def test_page_is_for_mujoco() -> None:
    with pytest.raises(UsageError, match=r"Pendulum-v1 is none.*record"):
        watch(untrained("Pendulum-v1"), browser=True)


@needs_page
def test_page_is_served_on_this_machine_alone_until_ctrl_c() -> None:
    code = (
        "import sys; from pacesetter import load; from pacesetter.media.watch import watch; "
        "watch(load(sys.argv[1]), port=18_089)"
    )
    hidden = {name: value for name, value in os.environ.items() if name not in module.DISPLAYS}
    shown = subprocess.Popen(
        [sys.executable, "-u", "-c", code, str(CHAMPION)],
        env=hidden,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert shown.stdout is not None
    try:
        told = next(found for line in shown.stdout if (found := re.search(r"http://\S+", line)))
        with urllib.request.urlopen(told[0]) as answer:
            assert b"<title>" in answer.read()
        shown.send_signal(signal.SIGINT)
        _, err = shown.communicate(timeout=60)
    finally:
        shown.kill()
    assert told[0].startswith("http://127.0.0.1:18")
    assert shown.returncode == 0, err
    assert "Traceback" not in err


@needs_page
def test_page_steps_the_task_once_per_frame_skip_and_resets_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    import mjviser
    import viser

    policy = untrained("HalfCheetah-v5", env_kwargs={"max_episode_steps": 3})
    seen: dict[str, Any] = {}

    class Viewer:
        def __init__(self, model: Any, data: Any, **given: Any) -> None:
            seen.update(given, model=model, data=data)

        def run(self) -> None:
            times = []
            for _ in range(4 * 5):  # five of the simulator's steps are one of the task
                seen["step_fn"](seen["model"], seen["data"])
                times.append(round(float(seen["data"].time), 6))
            assert times == [0.0] * 4 + [0.05] * 5 + [0.1] * 5 + [0.0] * 5 + [0.05]

    def server(**given: Any) -> str:
        seen.update(given)
        return "server"

    monkeypatch.setattr(mjviser, "Viewer", Viewer)
    monkeypatch.setattr(viser, "ViserServer", server)
    watch(policy, browser=True, port=9)
    assert (seen["host"], seen["port"], seen["server"]) == ("127.0.0.1", 9, "server")


@pytest.mark.usefixtures("bare")
def test_a_signal_that_ends_it_is_no_ctrl_c(monkeypatch: pytest.MonkeyPatch) -> None:
    """So that the exit code tells of it."""
    gymnasium.register("Shown-v1", entry_point=Shown)
    monkeypatch.setenv("DISPLAY", ":0")

    def stop(self: Policy, observation: Any) -> Any:
        raise Interrupted(signal.SIGTERM)

    monkeypatch.setattr(Policy, "act", stop)
    try:
        with pytest.raises(Interrupted):
            watch(untrained("Pendulum-v1"), env="Shown-v1")
    finally:
        del gymnasium.registry["Shown-v1"]


@pytest.mark.usefixtures("bare")
def test_a_window_keeps_the_pace_of_a_mujoco_task(monkeypatch: pytest.MonkeyPatch) -> None:
    """Gymnasium's own windows for MuJoCo do not wait; the camera is set once per env."""
    monkeypatch.setenv("DISPLAY", ":0")
    slept: list[float] = []
    followed: list[Any] = []
    monkeypatch.setattr(module, "sleep", slept.append)
    monkeypatch.setattr(module, "_follow", lambda world: followed.append(world.env))
    monkeypatch.setattr(MujocoEnv, "render", lambda self: None)
    policy = untrained("HalfCheetah-v5", env_kwargs={"max_episode_steps": 3}, renew_env=True)
    watch(policy, episodes=2)
    assert len(slept) == 6
    assert 0.1 < slept[2] <= 0.15  # three steps of a twentieth of a second, of no length here
    assert len({id(env) for env in followed}) == len(followed) == 3  # one of them for the check
