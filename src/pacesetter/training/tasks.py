"""The envs that a run trains in, and how it keeps their episodes apart."""

from dataclasses import replace
from typing import NamedTuple

from pacesetter.config import Config
from pacesetter.envs import Environment, apart
from pacesetter.envs.apart import Apart
from pacesetter.envs.tasks import Factory, Recipe
from pacesetter.seeding import Stream
from pacesetter.settings import OnPolicy


class Tasks(NamedTuple):
    """Envs, how to make another one, how episodes are kept apart, and what to tell a person."""

    envs: list[Environment]
    recipe: Recipe
    apart: Apart
    notes: list[str]


def make_tasks(config: Config, before: Apart | None, factory: Factory | None) -> Tasks:
    """The envs of a new run, or of one that kept its episodes apart in a way `before`."""
    run, hyper = config
    recipe = replace(config.recipe, factory=factory)
    how = before or apart.choose(recipe, run.renew_env)
    recipe = replace(recipe, renew=how is Apart.BY_RENEWAL)
    on_policy = isinstance(hyper, OnPolicy)
    count = hyper.parallel_envs if on_policy else run.members * hyper.num_envs
    envs = [Environment(recipe, run.seed, Stream.TRAIN, index) for index in range(count)]
    cast = envs[0].check()
    notes = [] if before else cast
    return Tasks(envs, recipe, how, notes + apart.notes(how, run.env, resumed=before is not None))
