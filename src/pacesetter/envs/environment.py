"""One env and its running episode: float32, actions in [-1, 1], seeded and resumed exactly."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from pacesetter.envs.spaces import action_bounds
from pacesetter.envs.tasks import make
from pacesetter.errors import TrainingError, UsageError
from pacesetter.policy import to_env
from pacesetter.seeding import Stream, episode_seed
from pacesetter.types import Floats

MAX_EPISODE = 100_000  # steps; an episode that never ends would hang every evaluation
MAX_REWARD = float(np.finfo(np.float32).max)  # the replay keeps rewards in float32


class Step(NamedTuple):
    """What one env step gave; `terminated` ends the task, `truncated` only the episode."""

    observation: Floats
    reward: float
    terminated: bool
    truncated: bool
    info: dict[str, Any]

    @property
    def ended(self) -> bool:
        return self.terminated or self.truncated


class Snapshot(NamedTuple):
    """Where an episode is: its number, its actions so far (T, A), the last observation (O,)."""

    episode: int
    actions: Floats
    observation: Floats


class Environment:
    """One env and its running episode.

    Each reset is seeded by the episode's number. An episode is therefore restored by its number and
    its actions, whatever the simulator is.
    """

    def __init__(
        self, name: str, kwargs: dict[str, Any], seed: int, stream: Stream, index: int = 0
    ) -> None:
        self.env = make(name, kwargs)
        self.name, self.seed, self.stream, self.index = name, seed, stream, index
        space: Any = self.env.action_space
        self.low, self.high = action_bounds(self.env)
        self.action_shape: tuple[int, ...] = space.shape
        self.action_type = space.dtype
        self.observation_shape: tuple[int, ...] = self.env.observation_space.shape or ()
        self.observation_size = int(np.prod(self.observation_shape))
        self.action_size = len(self.low)
        self.episode = -1
        self.actions: list[Floats] = []
        self.earned = 0.0  # rewards of the episode so far
        self.given: Any = None  # the last observation as the env gave it
        self.observation = np.zeros(self.observation_size, np.float32)

    def reset(self, episode: int | None = None) -> Floats:
        """Start an episode by its number, by default the next one."""
        self.episode = self.episode + 1 if episode is None else episode
        self.actions, self.earned = [], 0.0
        seed = episode_seed(self.seed, self.stream, self.index, self.episode)
        result: Any = self._call("reset", lambda: self.env.reset(seed=seed))
        if not (isinstance(result, tuple) and len(result) == 2):
            raise self._broken("reset", "must return (observation, info)")
        self.observation = self._observation(result[0])
        return self.observation

    def step(self, action: Floats) -> Step:
        """One step with an action (A,) in [-1, 1]."""
        if len(self.actions) >= MAX_EPISODE:
            why = f"has not ended after {MAX_EPISODE:,} steps; give the task a limit, such as"
            raise self._broken("episode", f"{why} --env.max_episode_steps 1000")
        self.actions.append(action)
        scaled = to_env(action, self.low, self.high)
        scaled = scaled.reshape(self.action_shape).astype(self.action_type)
        result: Any = self._call("step", lambda: self.env.step(scaled))
        if not (isinstance(result, tuple) and len(result) == 5):
            raise self._broken(
                "step", "must return (observation, reward, terminated, truncated, info)"
            )
        observation, reward, terminated, truncated, info = result
        if np.ndim(reward) != 0 or not isinstance(reward, (int, float, np.number)):
            raise self._broken("reward", f"must be one number, got {reward!r}")
        if not abs(reward) <= MAX_REWARD:
            raise self._broken("reward", f"must be finite in float32, got {reward}")
        for what, flag in (("terminated", terminated), ("truncated", truncated)):
            if not isinstance(flag, (bool, np.bool_)):
                raise self._broken(what, f"must be a bool, got {flag!r}")
        if not isinstance(info, dict):
            raise self._broken("info", f"must be a dict, got {info!r}")
        self.observation = self._observation(observation)
        self.earned += float(reward)
        return Step(self.observation, float(reward), bool(terminated), bool(truncated), info)

    def check(self) -> None:
        """Refuse an env that breaks the API, before anything is written."""
        try:
            self.reset(0)
            self._check_given()
            self.step(np.zeros(self.action_size, np.float32))
            self._check_given()
        except TrainingError as error:
            raise UsageError(f"env: {error}") from None
        self.episode = -1

    def _check_given(self) -> None:
        """Refuse an observation outside the env's own observation space."""
        space: Any = self.env.observation_space
        given = self.given
        if not isinstance(given, (np.ndarray, np.generic)):
            kind = type(given).__name__
            raise self._broken("observation", f"must be a NumPy array, it is a {kind}")
        if not np.can_cast(given.dtype, space.dtype):
            raise self._broken(
                "observation", f"must be {space.dtype} as its space is, got {given.dtype}"
            )
        outside = np.flatnonzero((given < space.low) | (given > space.high))
        if outside.size:
            where = int(outside[0])
            low, value, high = (np.ravel(x)[where] for x in (space.low, given, space.high))
            raise self._broken(
                "observation", f"number {where} is {value}, outside its space [{low}, {high}]"
            )

    def snapshot(self) -> Snapshot:
        """Where the running episode is."""
        shape = (len(self.actions), self.action_size)
        actions = np.array(self.actions, np.float32).reshape(shape)
        return Snapshot(self.episode, actions, self.observation)

    def restore(self, snapshot: Snapshot) -> bool:
        """Replay the snapshot's episode; False if the env does not repeat it exactly."""
        self.reset(snapshot.episode)
        for action in snapshot.actions:
            if self.step(action).ended:
                break
        return np.array_equal(self.observation, snapshot.observation) and len(self.actions) == len(
            snapshot.actions
        )

    def close(self) -> None:
        self._call("close", self.env.close)

    def _call(self, what: str, function: Callable[[], Any]) -> Any:
        try:
            return function()
        except Exception as error:
            raise self._broken(what, f"failed: {type(error).__name__}: {error}") from error

    def _observation(self, observation: Any) -> Floats:
        try:
            flat = np.array(observation, np.float32).ravel()
        except (TypeError, ValueError):
            raise self._broken("observation", f"must be numbers, got {observation!r}") from None
        if np.shape(observation) != self.observation_shape:
            shape = np.shape(observation)
            raise self._broken(
                "observation", f"must have shape {self.observation_shape}, has {shape}"
            )
        self.given = observation
        if not np.isfinite(flat).all():
            where = int(np.flatnonzero(~np.isfinite(flat))[0])
            raise self._broken("observation", f"must be finite, number {where} is {flat[where]}")
        return flat

    def _broken(self, what: str, why: str) -> TrainingError:
        return TrainingError(f"{self.name}: {what}: {why}")
