"""One env and its running episode: float32, actions in [-1, 1], seeded and resumed exactly."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from pacesetter.envs import border
from pacesetter.envs.border import Step
from pacesetter.envs.calls import call
from pacesetter.envs.spaces import action_bounds
from pacesetter.envs.tasks import Recipe
from pacesetter.envs.wrappers import notes_on_wrappers
from pacesetter.errors import TaskError, UsageError
from pacesetter.policy import to_env
from pacesetter.seeding import Range, Stream, draw_task, episode_seed
from pacesetter.types import Floats

MAX_EPISODE = 100_000  # steps; an episode that never ends would hang every evaluation


class Snapshot(NamedTuple):
    """Where an episode is: its number, its actions so far (T, A), the last observation (O,)."""

    episode: int
    actions: Floats
    observation: Floats


class Environment:
    """One env and its running episode.

    Each reset is seeded by the episode's number. An episode is therefore restored by its number and
    its actions, whatever the simulator is. One that carries state from one episode to the next is
    made anew at each, and so is one whose keywords are drawn from `ranges`.
    """

    def __init__(
        self,
        recipe: Recipe,
        seed: int,
        stream: Stream,
        index: int = 0,
        ranges: Mapping[str, Range] = MappingProxyType({}),
    ) -> None:
        self.recipe, self.ranges, self.env = recipe, ranges, recipe.make()
        self.name, self.seed, self.stream, self.index = recipe.name, seed, stream, index
        space: Any = self.env.action_space
        self.low, self.high = action_bounds(self.env)
        self.action_shape: tuple[int, ...] = space.shape
        self.action_type = space.dtype
        self.observation_shape: tuple[int, ...] = self.env.observation_space.shape or ()
        self.observation_size = int(np.prod(self.observation_shape))
        self.action_size = len(self.low)
        self.new = True  # no episode has begun in it
        self.episode = -1
        self.actions: list[Floats] = []
        self.earned = 0.0  # rewards of the episode so far
        self.given: Any = None  # the last observation as the env gave it
        self.paid: tuple[Any, ...] = ()  # the last reward and flags as the env gave them
        self.observation = np.zeros(self.observation_size, np.float32)

    def reset(self, episode: int | None = None) -> Floats:
        """Start an episode by its number, by default the next one."""
        episode = self.episode + 1 if episode is None else episode
        if self.ranges or (self.recipe.renew and not self.new):
            self.renew(episode)
        self.new = False
        seed = episode_seed(self.seed, self.stream, self.index, episode)
        result: Any = self._call("reset", self.env.reset, seed=seed)
        if not (isinstance(result, tuple) and len(result) == 2):
            raise self._broken("reset: must return (observation, info)")
        try:
            self.observation = border.observation(result[0], self.observation_shape)
        except ValueError as error:
            raise self._broken(error) from None
        self.given = result[0]
        self.episode, self.actions, self.earned = episode, [], 0.0
        return self.observation

    def step(self, action: Floats) -> Step:
        """One step with an action (A,) in [-1, 1]; after a fault the episode is as before it."""
        if len(self.actions) >= MAX_EPISODE:
            why = f"has not ended after {MAX_EPISODE:,} steps; give the task a limit, such as"
            raise self._broken(f"episode: {why} --env.max_episode_steps 1000")
        scaled = to_env(action, self.low, self.high)
        scaled = scaled.reshape(self.action_shape).astype(self.action_type)
        result: Any = self._call("step", self.env.step, scaled)
        try:
            step = border.step(result, self.observation_shape)
        except ValueError as error:
            raise self._broken(error) from None
        self.given, self.paid = result[0], result[1:4]
        self.observation = step.observation
        self.actions.append(action)
        self.earned += step.reward
        return step

    def check(self) -> list[str]:
        """Refuse an env that breaks the API, before anything is written; what had to be cast."""
        space = self.env.observation_space
        try:
            self.reset(0)
            notes = [*notes_on_wrappers(self.env)]
            notes += border.notes_on_observation(self.given, space)
            self.step(np.zeros(self.action_size, np.float32))
        except TaskError as error:
            raise UsageError(f"env: {error}") from None
        notes += [*border.notes_on_observation(self.given, space), *border.notes_on_step(self.paid)]
        self.episode = -1
        return [f"env: {self.name}: {'; '.join(dict.fromkeys(notes))}"] if notes else []

    def snapshot(self) -> Snapshot:
        """Where the running episode is."""
        shape = (len(self.actions), self.action_size)
        actions = np.array(self.actions, np.float32).reshape(shape)
        return Snapshot(self.episode, actions, self.observation)

    def restore(self, snapshot: Snapshot) -> bool:
        """Replay the snapshot's episode, which still ran; False if the env does not repeat it
        exactly.
        """
        self.reset(snapshot.episode)
        for action in snapshot.actions:
            if self.step(action).ended:
                return False
        return np.array_equal(self.observation, snapshot.observation)

    def close(self) -> None:
        self._call("close", self.env.close)

    def renew(self, episode: int) -> None:
        """Make the task anew, with an episode's own keywords if they are drawn."""
        drawn = draw_task(self.seed, self.stream, self.index, episode, self.ranges)
        recipe = replace(self.recipe, kwargs=self.recipe.kwargs | drawn)
        self.close()
        self.env = self._call("episode", recipe.make)
        if not np.array_equal(action_bounds(self.env), (self.low, self.high)):
            raise self._broken(f"episode: its action space changed with {drawn}")

    def _call(self, what: str, function: Callable[..., Any], *given: Any, **named: Any) -> Any:
        limit = self.recipe.timeout
        return call(f"{self.name}: {what}: failed", limit, function, *given, **named)

    def _broken(self, why: object) -> TaskError:
        return TaskError(f"{self.name}: {why}")
