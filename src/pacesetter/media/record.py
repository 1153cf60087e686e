"""A film of a policy at its task, drawn without a display."""

from collections.abc import Iterator
from itertools import chain, count, islice
from math import ceil
from pathlib import Path
from typing import Any, NamedTuple

from pacesetter.envs import Environment, Recipe
from pacesetter.errors import UsageError
from pacesetter.files import replacing
from pacesetter.media.caption import caption
from pacesetter.media.scene import Frame, check_folder, check_size, draw, scene, setting
from pacesetter.policy import Policy

SUFFIXES = (".mp4", ".gif")
FASTEST = 50.0  # frames per second; a GIF knows no more and eyes see no more


class Film(NamedTuple):
    """What was written: frames, frames per second, and the return of each episode that ended."""

    frames: int
    rate: float
    returns: list[float]


def record(
    policy: Policy,
    path: str | Path,
    *,
    episodes: int | None = None,
    frames: int | None = None,
    camera: str | None = None,
    size: tuple[int, int] = (640, 480),
    env: str | Recipe | None = None,
    env_kwargs: dict[str, Any] | None = None,
    seed: int = 0,
    text: bool = True,
) -> Film:
    """Film seeded episodes, one after another, at the env's own pace, as .mp4 or .gif.

    Films `episodes` (default 1, or without end where `frames` is given), at most `frames` frames.
    `camera` is one of a MuJoCo model's own, or `free`; default `track`, which follows the walker.
    `size` is that of MuJoCo tasks; others draw in a size of their own.
    """
    path = Path(path)
    _check(path, episodes, frames)
    check_size(size)
    if episodes is None and frames is None:
        episodes = 1
    returns: list[float] = []
    with scene(policy, env, env_kwargs, seed, size, camera) as world:
        pace = float(world.env.metadata.get("render_fps") or 30)
        every = ceil(pace / FASTEST)
        film = _film(policy, world, episodes, every, returns, text)
        written = _write(path, islice(film, frames), pace / every)
    return Film(written, pace / every, returns)


def _check(path: Path, episodes: int | None, frames: int | None) -> None:
    if path.suffix not in SUFFIXES:
        raise UsageError(f"video: {path} must end in {' or '.join(SUFFIXES)}")
    for name, number in (("episodes", episodes), ("frames", frames)):
        if number is not None and number < 1:
            raise UsageError(f"{name}: must be at least 1, got {number}")
    check_folder("video", path)


def _film(
    policy: Policy,
    world: Environment,
    episodes: int | None,
    every: int,
    returns: list[float],
    text: bool,
) -> Iterator[Frame]:
    """Every so many steps a frame, and one of each episode's end; its return goes to `returns`."""
    for _ in count() if episodes is None else range(episodes):
        observation, step, ended = world.reset(), 0, False
        while True:
            if ended:
                returns.append(world.earned)
            if ended or step % every == 0:
                words = f"step {step:,}   return {world.earned:,.1f}"
                yield caption(draw(world), words) if text else draw(world)
            if ended:
                break
            observation, _, terminated, truncated, _ = world.step(policy.act(observation))
            step, ended = step + 1, terminated or truncated


def _write(path: Path, film: Iterator[Frame], rate: float) -> int:
    import imageio.v2

    library: Any = imageio.v2
    ahead = [*islice(film, 2)]  # so that no file is made where nothing can be drawn
    durations: list[int] = []  # of frames; a GIF's are read when it is closed
    told = durations if len(ahead) > 1 else duration(0, rate)  # as Pillow wants it
    try:
        # Otherwise ffmpeg is started by a plain fork, which JAX's threads make unsafe.
        with (
            replacing(path) as file,
            setting("IMAGEIO_FFMPEG_NO_PREVENT_SIGINT", "1"),
            library.get_writer(file, **_options(path.suffix, rate, told)) as writer,
        ):
            for number, frame in enumerate(chain(ahead, film)):
                writer.append_data(frame)
                durations.append(duration(number, rate))
    except OSError as error:
        reason = error.strerror or next(iter(str(error).splitlines()), type(error).__name__)
        raise UsageError(f"video: cannot write {path}: {reason}") from None
    return len(durations)


def duration(number: int, rate: float) -> int:
    """Milliseconds of a frame, in whole hundredths of a second, which is all a GIF knows.

    They add up to the film's own time. None is below two, as viewers play those at ten.
    """
    begin, end = (round(100 * frame / rate) for frame in (number, number + 1))
    return 10 * max(2, end - begin)


def _options(suffix: str, rate: float, durations: list[int] | int) -> dict[str, Any]:
    if suffix == ".gif":
        return {"mode": "I", "duration": durations, "loop": 0}
    return {
        "format": "FFMPEG",
        "fps": rate,
        "codec": "libx264",
        "pixelformat": "yuv420p",
        "macro_block_size": 2,
    }
