"""A poster shows the frames that it names, and a gait's cycle is found where there is one."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from policies import untrained

from pacesetter import load
from pacesetter.envs import Environment
from pacesetter.errors import UsageError
from pacesetter.media.poster import GAP, period, poster
from pacesetter.media.scene import draw, scene
from pacesetter.policy import Policy

CHAMPION = Path(__file__).parents[2] / "champions" / "HalfCheetah-v4-sac.safetensors"


@pytest.fixture
def cheetah() -> Policy:
    return untrained("HalfCheetah-v5", env_kwargs={"max_episode_steps": 20})


def picture(path: Path) -> Any:
    import imageio.v3

    library: Any = imageio.v3
    return library.imread(path)[..., :3]


@pytest.mark.usefixtures("gl")
def test_frames_are_those_of_their_steps(cheetah: Policy, tmp_path: Path) -> None:
    path = tmp_path / "strip.png"
    assert poster(cheetah, path, frames=3, size=(64, 48), seed=2) == [0, 10, 20]
    strip = picture(path)
    assert strip.shape[1] == 3 * 64 + 2 * GAP
    with scene(cheetah, None, None, 2, (64, 48), None) as world:
        observation = world.reset(0)
        for step in range(21):
            if step in (0, 10, 20):
                left = step // 10 * (64 + GAP)
                shown = strip[:48, left : left + 64].astype(int)
                assert np.abs(shown - draw(world)).mean() < 4  # of 256 colours
            if step < 20:
                observation = world.step(cheetah.act(observation)).observation


@pytest.mark.usefixtures("gl")
def test_champion_by_default_fits_a_paper(tmp_path: Path) -> None:
    path = tmp_path / "strip.png"
    assert len(poster(load(CHAMPION), path)) == 8
    assert 10_000 < path.stat().st_size < 300_000
    assert picture(path).shape[1] == 8 * 240 + 7 * GAP


@pytest.mark.usefixtures("gl")
def test_cycle_of_the_champions_gait(tmp_path: Path) -> None:
    steps = poster(load(CHAMPION), tmp_path / "strip.png", cycle=True, size=(64, 48))
    assert steps[0] == 500
    assert 3 <= len(steps) <= 8
    assert np.diff(steps).min() >= 1


@pytest.mark.parametrize("cycle", [7, 24])
def test_period_of_a_movement(cycle: int, rng: np.random.Generator) -> None:
    time = np.arange(300)[:, None]
    phases = rng.uniform(0, 6, 5)
    states = np.sin(2 * np.pi * time / cycle + phases) + rng.normal(0, 0.2, (300, 5))
    assert period(states) == cycle
    assert period(np.hstack([states, np.full((300, 1), 3.0)])) == cycle  # one that stands still


def test_nothing_repeats_in_noise_or_rest(rng: np.random.Generator) -> None:
    assert period(rng.normal(size=(300, 5))) is None
    assert period(np.ones((300, 5))) is None


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"path": "strip.jpg"}, r"must end in \.png"),
        ({"frames": 0}, "frames: must be at least 1"),
        ({"size": (63, 48)}, "size: both sides must be even"),
        ({"path": "none/strip.png"}, "cannot write"),
    ],
)
def test_bad_input_is_one_line(
    cheetah: Policy, tmp_path: Path, settings: dict[str, Any], said: str
) -> None:
    path = tmp_path / settings.get("path", "strip.png")
    rest = {key: value for key, value in settings.items() if key != "path"}
    with pytest.raises(UsageError, match=said):
        poster(cheetah, path, **rest)
    assert not path.exists()


@pytest.mark.usefixtures("gl")
def test_a_poster_that_fails_leaves_the_one_before(
    cheetah: Policy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(self: Image.Image, path: Path, **how: Any) -> None:
        Path(path).write_bytes(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Image.Image, "save", fail)
    (tmp_path / "probe.gif").unlink()
    file = tmp_path / "strip.png"
    file.write_bytes(b"of yesterday")
    with pytest.raises(UsageError, match="No space"):
        poster(cheetah, file, frames=1, size=(64, 48))
    assert [(path.name, path.read_bytes()) for path in tmp_path.iterdir()] == [
        (file.name, b"of yesterday")
    ]


@pytest.mark.usefixtures("gl")
def test_no_poster_of_a_task_that_does_not_repeat(
    cheetah: Policy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its pictures would be of another episode than their steps."""
    reset, lengths = Environment.reset, iter(range(100))

    def restless(world: Environment, episode: int | None = None) -> Any:
        return reset(world, next(lengths))

    monkeypatch.setattr(Environment, "reset", restless)
    with pytest.raises(UsageError, match="does not repeat an episode"):
        poster(cheetah, tmp_path / "strip.png", size=(64, 48))
    assert not (tmp_path / "strip.png").exists()
