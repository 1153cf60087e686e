"""Films of champions, as data URLs for a page that asks nobody."""

import base64
from collections.abc import Collection, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from pacesetter.errors import TrainingError, UsageError
from pacesetter.evaluation import recipe_of
from pacesetter.study.compare.groups import Comparison
from pacesetter.study.compare.results import Run

FILM_FRAMES = 200
FILM_SIZE = (480, 320)


class Film(NamedTuple):
    """A champion at its task, as a data URL; or why there is none."""

    caption: str
    data: str = ""


def films(comparison: Comparison, allow: Collection[str] = ()) -> Iterator[Film]:
    """One film per task, of its best run: of tasks that import no module or that `allow` names."""
    for env in comparison.envs:
        runs = [run for run in comparison.runs if run.env == env]
        yield _film(max(runs, key=lambda run: run.metric("final")), allow)


def _film(run: Run, allow: Collection[str]) -> Film:
    """The policy that a run ended with."""
    what = f"{run.env}: {run.name} seed {run.seed}"
    if run.folder is None:
        return Film(f"{what}: no film, since results hold no policy; name its run directory.")
    from pacesetter.media.record import record
    from pacesetter.policy import load

    try:
        policy = load(run.folder)
        with TemporaryDirectory() as folder:
            path = Path(folder) / "film.mp4"
            env = recipe_of(policy.about, None, allow=allow)
            record(policy, path, env=env, frames=FILM_FRAMES, size=FILM_SIZE)
            data = base64.b64encode(path.read_bytes()).decode()
    except (UsageError, TrainingError) as error:  # no reason to write no report
        return Film(f"{what}: no film: {error}")
    step = policy.about.get("step", 0)
    caption = (
        f"{what}, the policy of step {step:,}: the best of {run.env} by final return, so it "
        "flatters."
    )
    return Film(caption, f"data:video/mp4;base64,{data}")
