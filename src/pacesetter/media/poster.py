"""A strip of frames, as papers print it."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pacesetter.envs import Environment, Recipe
from pacesetter.errors import UsageError, writing
from pacesetter.files import replacing
from pacesetter.media.scene import Frame, check_folder, check_size, draw, scene
from pacesetter.policy import Policy

GAP = 6  # pixels of white between frames
ALIKE = 0.3  # autocorrelation from which a movement counts as one that repeats


def poster(
    policy: Policy,
    path: str | Path,
    *,
    frames: int = 8,
    size: tuple[int, int] = (240, 180),
    cycle: bool = False,
    camera: str | None = None,
    env: str | Recipe | None = None,
    env_kwargs: dict[str, Any] | None = None,
    seed: int = 0,
) -> list[int]:
    """Draw one episode as a strip of frames in a .png and return their steps.

    Frames are evenly spaced over the episode; with `cycle`, over one cycle of the gait from its
    middle on, with fewer frames where a cycle has fewer steps. `size` is of one frame.
    """
    path = Path(path)
    if path.suffix != ".png":
        raise UsageError(f"poster: {path} must end in .png")
    if frames < 1:
        raise UsageError(f"frames: must be at least 1, got {frames}")
    check_size(size)
    check_folder("poster", path)
    with scene(policy, env, env_kwargs, seed, size, camera) as world:
        states = _walk(policy, world)
        steps = _cycle(states, frames) if cycle else _evenly(0, len(states) - 1, frames)
        pictures = _pictures(policy, world, states, steps)
    _save(path, pictures, steps)
    return steps


def _walk(policy: Policy, world: Environment) -> NDArray[np.float64]:
    """Observations (T + 1, O) of the first episode."""
    states, ended = [world.reset(0)], False
    while not ended:
        step = world.step(policy.act(states[-1]))
        states.append(step.observation)
        ended = step.ended
    return np.asarray(states, np.float64)


def _evenly(first: int, last: int, frames: int) -> list[int]:
    return sorted({round(step) for step in np.linspace(first, last, frames)})


def _cycle(states: NDArray[np.float64], frames: int) -> list[int]:
    """Steps over one cycle from the middle of the episode on, none of them twice."""
    middle = len(states) // 2
    cycle = period(states[middle:])
    if cycle is None:
        raise UsageError("cycle: nothing in this episode repeats; leave it out")
    return [middle + step for step in _evenly(0, cycle, frames + 1)[:-1]]


def period(states: NDArray[np.float64]) -> int | None:
    """Steps after which states (T, O) repeat: the first peak of their mean autocorrelation."""
    centred = states - states.mean(axis=0)
    moving = centred[:, centred.std(axis=0) > 1e-6]
    if moving.size == 0:
        return None
    scaled = moving / moving.std(axis=0)
    lags = range(len(scaled) // 3)
    alike = np.array([(scaled[: len(scaled) - lag] * scaled[lag:]).mean() for lag in lags])
    for lag in range(2, len(alike) - 1):
        if alike[lag] >= max(ALIKE, alike[lag - 1], alike[lag + 1]):
            return lag
    return None


def _pictures(
    policy: Policy, world: Environment, states: NDArray[np.float64], steps: list[int]
) -> list[Frame]:
    """Go through the same episode once more, since only now it is known what to draw."""
    observation, pictures = world.reset(0), list[Frame]()
    for step in range(steps[-1] + 1):
        if not np.array_equal(observation, states[step]):
            raise UsageError(
                f"env: {world.name} does not repeat an episode from its seed, so no poster of it; "
                "make a film with `pacesetter record`"
            )
        if step in steps:
            pictures.append(draw(world))
        if step < steps[-1]:
            observation = world.step(policy.act(observation)).observation
    return pictures


def _save(path: Path, pictures: list[Frame], steps: list[int]) -> None:
    from PIL import Image, ImageDraw, ImageFont

    height, width = pictures[0].shape[:2]
    letters = max(10, height // 11)
    whole = (len(pictures) * (width + GAP) - GAP, height + 2 * letters)
    strip = Image.new("RGB", whole, "white")
    pen, font = ImageDraw.Draw(strip), ImageFont.load_default(letters)
    for n, (picture, step) in enumerate(zip(pictures, steps, strict=True)):
        left = n * (width + GAP)
        strip.paste(Image.fromarray(picture), (left, 0))
        pen.text((left + width / 2, height + letters), f"step {step:,}", "black", font, "mm")
    # 256 colours without dithering: a third of the bytes, and nobody sees it.
    with writing("poster", path), replacing(path) as file:
        strip.quantize(256, dither=Image.Dither.NONE).save(file, optimize=True)
