"""The verbs `record`, `poster` and `watch`: a policy at its task."""

import argparse
import re

from pacesetter.cli.flags import Parser, parser
from pacesetter.cli.policies import add_run, add_seed, parse
from pacesetter.cli.streams import aside


def record(words: list[str]) -> int:
    """Film a policy as .mp4 or .gif."""
    command = parser("record", "Film a run's policy, or a policy file, without a display.")
    add_run(command)
    add = command.add_argument
    add("-o", default="walk.mp4", metavar="FILE", help="a .mp4 or .gif (default walk.mp4)")
    episodes = "episodes to film (default 1, or as many as --frames takes)"
    add("--episodes", type=int, metavar="N", help=episodes)
    add("--frames", type=int, metavar="N", help="end after N frames")
    _add_view(command, "640x480", "of the film")
    add("--no-text", action="store_true", help="leave step and return out of the picture")
    add_seed(command)
    given, found = parse(command, words)
    from pacesetter.media.record import record

    with aside():
        film = record(
            found.policy,
            given.o,
            episodes=given.episodes,
            frames=given.frames,
            camera=given.camera,
            size=given.size,
            seed=given.seed,
            text=not given.no_text,
            **found.task,
        )
    seconds = film.frames / film.rate
    returns = ", ".join(f"{value:,.1f}" for value in film.returns)
    ended = f"; return {returns}" if returns else "; no episode ended"
    print(f"{given.o}: {film.frames:,} frames, {seconds:.1f} s{ended}")
    return 0


def poster(words: list[str]) -> int:
    """Draw an episode as a strip of frames, .png."""
    command = parser("poster", "Draw an episode of a policy as a strip of frames, for a paper.")
    add_run(command)
    add = command.add_argument
    add("-o", default="walk.png", metavar="FILE", help="a .png (default walk.png)")
    add("--frames", type=int, default=8, metavar="N", help="frames in the strip (default 8)")
    add("--cycle", action="store_true", help="draw one cycle of the gait, not the whole episode")
    _add_view(command, "240x180", "of one frame")
    add_seed(command)
    given, found = parse(command, words)
    from pacesetter.media.poster import poster

    with aside():
        steps = poster(
            found.policy,
            given.o,
            frames=given.frames,
            size=given.size,
            cycle=given.cycle,
            camera=given.camera,
            seed=given.seed,
            **found.task,
        )
    print(f"{given.o}: steps {', '.join(f'{step:,}' for step in steps)}")
    return 0


def watch(words: list[str]) -> int:
    """Watch a policy live, in a window or a browser."""
    command = parser("watch", "Show a policy at its task until Ctrl-C.")
    add_run(command)
    add = command.add_argument
    page = "serve a page for a browser of this machine, instead of a window"
    add("--browser", action=argparse.BooleanOptionalAction, help=page)
    add("--port", type=int, default=8080, metavar="N", help="port of the page (default 8080)")
    episodes = "episodes to show in a window (default no end)"
    add("--episodes", type=int, metavar="N", help=episodes)
    add_seed(command)
    given, found = parse(command, words)
    from pacesetter.media.watch import watch

    with aside():
        watch(
            found.policy,
            browser=given.browser,
            episodes=given.episodes,
            port=given.port,
            seed=given.seed,
            **found.task,
        )
    return 0


def _add_view(command: Parser, size: str, what: str) -> None:
    """`--camera` and `--size`."""
    camera = "camera of the MuJoCo model, or free (default track, which follows the walker)"
    command.add_argument("--camera", metavar="NAME", help=camera)
    about = f"width and height {what} in pixels (default {size})"
    command.add_argument("--size", type=_size, default=_size(size), metavar="WxH", help=about)


def _size(text: str) -> tuple[int, int]:
    found = re.fullmatch(r"(\d{1,4})x(\d{1,4})", text.lower())
    if found is None:
        raise argparse.ArgumentTypeError(f"'{text}' is no size; write 640x480")
    return int(found[1]), int(found[2])
