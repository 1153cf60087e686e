"""The envs that a run trains in, and how it keeps their episodes apart."""

from collections.abc import Generator, Iterable
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

from pacesetter.config import Config
from pacesetter.envs import Environment, apart
from pacesetter.envs.apart import Apart
from pacesetter.envs.tasks import Factory, Recipe
from pacesetter.errors import TaskError
from pacesetter.seeding import Stream
from pacesetter.settings import OnPolicy


class Tasks(NamedTuple):
    """Envs, how to make another one, how episodes are kept apart, and what to tell a person."""

    envs: list[Environment]
    recipe: Recipe
    apart: Apart
    notes: list[str]


@contextmanager
def closed_by_a_fault(things: Iterable[Any]) -> Generator[None]:
    """Close all things if the block raises, whose error is the one to be seen."""
    try:
        yield
    except BaseException:
        for each in things:
            with suppress(TaskError):
                each.close()
        raise


def make_tasks(config: Config, before: Apart | None, env: str | Factory | None) -> Tasks:
    """The envs of a new run, or of one that kept its episodes apart in a way `before`.

    `env` is what a person gave: an id, which may lack its version, or a function that makes envs.
    """
    run, hyper = config
    recipe = replace(config.recipe, factory=env if callable(env) else None)
    how = before or apart.choose(recipe, run.renew_env)
    recipe = replace(recipe, renew=how is Apart.BY_RENEWAL)
    on_policy = isinstance(hyper, OnPolicy)
    count = hyper.parallel_envs if on_policy else run.members * hyper.num_envs
    world = partial(Environment, recipe, run.seed, Stream.TRAIN, ranges=run.randomize)
    envs: list[Environment] = []
    with closed_by_a_fault(envs):
        envs.extend(world(index=index) for index in range(count))
        cast = envs[0].check()
    notes = [] if before else cast
    if isinstance(env, str) and env != run.env:
        notes.insert(0, f"env: '{env}' has no version; taking the newest, {run.env}")
    return Tasks(envs, recipe, how, notes + apart.notes(how, run.env, resumed=before is not None))
