"""How episodes are kept apart: a run is resumed exactly only if none depends on those before it.

Some simulators carry state over a reset, such as Box2D the order of its contacts. A few episodes
tell: each is played in an env that has seen many before it, and in a new one.
"""

from contextlib import suppress
from enum import StrEnum
from typing import Any

import gymnasium
import numpy as np

from pacesetter.envs.environment import Environment
from pacesetter.envs.tasks import Recipe
from pacesetter.errors import TrainingError, UsageError, show
from pacesetter.seeding import Stream

BEFORE, FEW = 16, 10  # episodes that age an env, and their steps: cheap ones, but many resets
EPISODES, STEPS = 4, 100  # that are compared
WHOLE_RESET = ("gymnasium.envs.mujoco", "pacesetter.envs.ant")  # set all of MuJoCo's state


class Apart(StrEnum):
    """What keeps a run's episodes apart."""

    BY_RESET = "reset"
    BY_RENEWAL = "renewal"
    UNTESTED = "untested"
    NOT = "not"


def recorded(record: dict[str, Any]) -> Apart | None:
    """As a run's config.json says it, or None where an older version made that."""
    found = [each["apart"] for each in (record, *record.get("resumed", [])) if "apart" in each]
    if found and found[0] not in [*Apart]:
        raise UsageError(f"apart: must be one of {', '.join(Apart)}, got {show(found[0])}")
    return Apart(found[0]) if found else None


def notes(apart: Apart, name: str, resumed: bool) -> list[str]:
    """What a person should know of a task when a run begins or is resumed; mostly nothing."""
    texts = ON_RESUME if resumed else AT_START
    return [f"env: {name}: {texts[apart]}"] if apart in texts else []


LATER = "a resumed run differs from one that was never stopped"
AT_START = {
    Apart.BY_RENEWAL: "carries state from one episode to the next, so it is made anew at each; "
    f"--no-renew-env keeps it, and then {LATER}",
    Apart.NOT: f"does not repeat an episode from its seed, so {LATER}; its random numbers should "
    "come from self.np_random",
}
ON_RESUME = {
    Apart.UNTESTED: f"is kept from one episode to the next; if it carries state, {LATER}",
    Apart.NOT: f"does not repeat an episode from its seed, so {LATER}",
}


def choose(recipe: Recipe, renew: bool | None) -> Apart:
    """As is wished, or by a test, which makes the task some times more."""
    if recipe.factory is not None:
        _refuse_shared(recipe)
    if renew is not None:
        return Apart.BY_RENEWAL if renew else Apart.UNTESTED
    if _resets_wholly(recipe.name) and not recipe.wrap:
        return Apart.BY_RESET
    aged = Environment(recipe, 0, Stream.REPORT)
    for number in range(BEFORE):
        _play(aged, number, FEW)
    numbers = range(BEFORE, BEFORE + EPISODES)
    differs = (n for n in numbers if _play(aged, n, STEPS) != _play_in_new(recipe, n))
    number = next(differs, None)
    _close(aged)
    if number is None:
        return Apart.BY_RESET
    repeats = _play_in_new(recipe, number) == _play_in_new(recipe, number)
    return Apart.BY_RENEWAL if repeats else Apart.NOT


def _refuse_shared(recipe: Recipe) -> None:
    """Refuse a function that gives the same env twice: members and evaluations have their own."""
    one, other = recipe.make(), recipe.make()
    if one.unwrapped is other.unwrapped:
        raise UsageError(f"env: {recipe.name} must give a new env at each call, not the same one")
    one.close()
    other.close()


def _resets_wholly(name: str) -> bool:
    spec = gymnasium.registry.get(name)
    return spec is not None and str(spec.entry_point).startswith(WHOLE_RESET)


def _play_in_new(recipe: Recipe, number: int) -> list[Any]:
    world = Environment(recipe, 0, Stream.REPORT)
    try:
        return _play(world, number, STEPS)
    finally:
        _close(world)


def _play(world: Environment, number: int, steps: int) -> list[Any]:
    """All that an episode gives, bit for bit; every second one is of still actions, which let a
    body come to rest. What fails here is for the run to tell, with its step.
    """
    rng, size = np.random.default_rng(number), world.action_size
    seen: list[Any] = []
    try:
        seen.append(world.reset(number).tobytes())
        for _ in range(steps):
            action = rng.uniform(-1, 1, size) * (number % 2)
            step = world.step(action.astype(np.float32))
            seen.append((step.observation.tobytes(), *step[1:4]))
            if step.ended:
                break
    except TrainingError as error:
        seen.append(str(error))
    return seen


def _close(world: Environment) -> None:
    with suppress(TrainingError):
        world.close()
