"""Seeded rollouts of any policy, on envs and start states that training never sees."""

from collections.abc import Callable, Collection
from dataclasses import asdict, dataclass, replace
from math import inf
from typing import Any, TypeVar

import numpy as np

from pacesetter.consent import require
from pacesetter.envs import Environment, Recipe
from pacesetter.envs.border import reward_terms
from pacesetter.envs.ids import full_id
from pacesetter.errors import UsageError
from pacesetter.policy import Policy
from pacesetter.seeding import Stream, generator
from pacesetter.types import Floats

Act = Callable[[Floats], Floats]
World = TypeVar("World", bound=Environment)


@dataclass(frozen=True)
class Evaluation:
    """Undiscounted returns and lengths of complete episodes, and the mean reward terms of one."""

    returns: list[float]
    lengths: list[int]
    mean: float
    std: float
    terms: dict[str, float]

    def __repr__(self) -> str:
        count = len(self.returns)
        return f"Evaluation(mean {self.mean:.1f}, std {self.std:.1f}, {count} returns)"

    def table(self) -> dict[str, Any]:
        """As plain JSON."""
        return asdict(self)


def rollouts(
    act: Act, env: Environment, episodes: int, first: int = 0, limit: float = inf
) -> Evaluation:
    """Run episodes `first`, `first + 1`, ... with actions in [-1, 1]; std is over episodes, ddof 0.

    Stops after `limit` steps in all, even within an episode.
    """
    returns: list[float] = []
    lengths: list[int] = []
    terms: dict[str, float] = {}
    for episode in range(first, first + episodes):
        observation, total, length, ended = env.reset(episode), 0.0, 0, False
        while not ended and sum(lengths) + length < limit:
            step = env.step(act(observation))
            observation, ended = step.observation, step.ended
            total += step.reward
            length += 1
            for name, value in reward_terms(step.info):
                terms[name] = terms.get(name, 0.0) + value / episodes
        returns.append(total)
        lengths.append(length)
    return Evaluation(returns, lengths, float(np.mean(returns)), float(np.std(returns)), terms)


def evaluate(
    policy: Policy | None,
    env: str | Recipe | None = None,
    episodes: int = 10,
    seed: int = 0,
    *,
    noise: float = 0.0,
    env_kwargs: dict[str, Any] | None = None,
    random: bool = False,
) -> Evaluation:
    """Evaluate a policy on fresh episodes; without one, or if asked to, uniformly random actions.

    The env defaults to the policy's own; a `Recipe` gives one with wrappers. `noise` is the
    standard deviation of Gaussian noise on actions in [-1, 1]. Raises UsageError.
    """
    if episodes < 1:
        raise UsageError(f"episodes: must be at least 1, got {episodes}")
    if seed < 0:
        raise UsageError(f"seed: must be at least 0, got {seed}")
    if not 0 <= noise < inf:
        raise UsageError(f"noise: must be a finite number, at least 0, got {noise}")
    world = enter(policy, env, seed, env_kwargs)
    try:
        acting = _acting(None if random else policy, world, noise, seed)
        return rollouts(acting, world, episodes)
    finally:
        world.close()


def enter(
    policy: Policy | None,
    env: str | Recipe | None,
    seed: int,
    env_kwargs: dict[str, Any] | None = None,
    kind: Callable[[Recipe, int, Stream], World] = Environment,
    **extra: Any,
) -> World:
    """Make the given task or the policy's own and check that they fit; `extra` are its keywords."""
    recipe = recipe_of(policy.about if policy else {}, env, env_kwargs)
    world = kind(replace(recipe, kwargs=recipe.kwargs | extra), seed, Stream.REPORT)
    world.check()
    if policy is not None:
        _refuse_unfit(policy, world)
    return world


def recipe_of(
    about: dict[str, Any],
    env: str | Recipe | None,
    env_kwargs: dict[str, Any] | None = None,
    allow: Collection[str] = (),
) -> Recipe:
    """The task by its id, with what the policy's file says of it if it is the policy's own.

    Names of modules that the file gives must be among `allow`, or loaded. Raises UsageError.
    """
    if isinstance(env, Recipe):
        if env_kwargs:
            raise UsageError("env_kwargs: a Recipe has its own; give the keywords to it")
        return env
    name = full_id(env) if isinstance(env, str) else env or about.get("env")
    if name is not None and not isinstance(name, str):
        raise UsageError(f"env: must be an id such as HalfCheetah-v5, got a {type(name).__name__}")
    if name is None:
        raise UsageError("env: the policy names no env; give one with --env")
    require("env", name, [env, *allow])
    own = about if name == about.get("env") else {}
    for wrapper in own.get("wrap", ()):
        require("wrap", wrapper, allow)
    kwargs = own.get("env_kwargs", {}) if env_kwargs is None else env_kwargs
    return Recipe(name, kwargs, tuple(own.get("wrap", ())), bool(own.get("renew_env")))


def _refuse_unfit(policy: Policy, world: Environment) -> None:
    """Refuse a policy of other sizes or action bounds than the env's."""
    taken, given = policy.observation_size, len(policy.low)
    if (taken, given) != (world.observation_size, world.action_size):
        raise UsageError(
            f"env: {world.name} has observations of {world.observation_size} and actions of "
            f"{world.action_size}; the policy takes {taken} and gives {given}; play the task that "
            "it was trained on, by --env, --env.KEY and --wrap"
        )
    if not (np.array_equal(policy.low, world.low) and np.array_equal(policy.high, world.high)):
        raise UsageError(
            f"env: {world.name} has other action bounds than the policy; play the task that it was "
            "trained on"
        )


def _acting(policy: Policy | None, env: Environment, noise: float, seed: int) -> Act:
    rng = generator(seed, Stream.REPORT)
    size = env.action_size
    if policy is None:
        return lambda observation: rng.uniform(-1, 1, size).astype(np.float32)
    if noise == 0:
        return policy.act
    return lambda observation: (policy.act(observation) + noise * rng.normal(size=size)).astype(
        np.float32
    )
