"""One env: its episode, the noise of whoever explores it, and the policies that fit it."""

from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from pacesetter.algorithms.contract import Learner
from pacesetter.batch import Transition
from pacesetter.envs import Environment, Snapshot
from pacesetter.errors import TrainingError
from pacesetter.learner.normalizer import Normalizer
from pacesetter.learner.scales import scaled
from pacesetter.learner.tree_arrays import flatten, rebuild
from pacesetter.networks.forward import clip
from pacesetter.policy import Policy, unstack
from pacesetter.seeding import Stream, generator
from pacesetter.settings.validation import Finite, Natural, check
from pacesetter.types import ALLOWED, LARGEST, Arrays, Floats


@dataclass
class _Saved:
    """An explorer in a checkpoint."""

    streams: list[dict[str, Any]]
    episode: Annotated[int, Field(ge=-1, le=10**15)]
    earned: Finite
    starting: bool
    active: bool
    started: Natural


class Explorer:
    """Acts in one env; the learner's parameters are handed to it at every step."""

    def __init__(
        self, learner: Learner, env: Environment, params: Any, seed: int, index: int
    ) -> None:
        self.learner, self.env = learner, env
        streams = (Stream.WARMUP, Stream.ACT, Stream.MASK)
        self.streams = [generator(seed, stream, index) for stream in streams]
        self.warmup_stream, self.act_stream, self.mask_stream = self.streams
        # Only its shape counts before the first episode, so its stream is not used yet.
        self.noise_state = learner.start_episode(params, generator(seed, Stream.ACT))
        self.starting = True  # the next tick begins an episode
        self.active = True  # False while it waits for other members to end their episodes
        self.started = 0  # step of the run at which the episode began
        self.pending: Floats | None = None  # an action that was chosen and not yet made

    def start(self, params: Any, step: int) -> None:
        """Begin an episode at a step of the run."""
        self.env.reset()
        self.starting, self.active, self.started = False, True, step
        self.noise_state = self.learner.start_episode(params, self.act_stream)

    def random_action(self) -> Floats:
        """A uniform action of the warm-up."""
        return self.warmup_stream.uniform(-1, 1, self.env.action_size).astype(np.float32)

    def act(self, params: Any, observation: Floats, scales: dict[str, float]) -> Floats:
        """The exploring action of a learner with scaled settings for a normalised observation."""
        learner = scaled(self.learner, scales) if scales else self.learner
        action, self.noise_state = learner.act(
            params, self.noise_state, observation, self.act_stream
        )
        return action

    def step(self, action: Floats, gamma: float, clipped: bool) -> Transition:
        """Step the env with the clipped action; the transition holds it clipped or as it is."""
        if not np.logical_and.reduce(np.abs(action) <= LARGEST, axis=None):
            raise TrainingError(f"action: must be {ALLOWED}, is {action}")
        env, sent, self.pending = self.env, clip(action), action
        before, earned = env.observation, env.earned
        step = env.step(sent)
        self.pending = None
        self.active = not step.ended
        return Transition(
            observation=before,
            action=sent if clipped else action,
            reward=step.reward,
            next_observation=step.observation,
            discount=gamma * (1.0 - step.terminated),
            last=step.ended,
            mask=self.learner.mask(self.mask_stream),
            earned=earned,
        )

    def policy(self, state: Any, normalizer: Normalizer) -> Policy:
        """What acts without noise from a learner's state, in an env like this one."""
        actors, env = self.learner.policy(state), self.env
        return Policy(
            unstack(actors.layers), actors.activation, actors.output, env.low, env.high,
            normalizer.statistics() if normalizer.enabled else None,
            shapes=(env.observation_shape, env.action_shape),
        )  # fmt: skip

    @property
    def _running(self) -> bool:
        return self.active and not self.starting

    def arrays(self) -> Arrays:
        """The noise state and the running episode; of one that is over, only its number counts."""
        _, actions, observation = self.env.snapshot()
        if not self._running:
            actions, observation = actions[:0], np.zeros_like(observation)
        noise = flatten({"noise_state": self.noise_state})
        pending = {} if self.pending is None else {"pending": self.pending}
        return {"actions": actions, "observation": observation, **noise, **pending}

    def table(self) -> dict[str, Any]:
        return {
            "streams": [stream.bit_generator.state for stream in self.streams],
            "episode": self.env.episode,
            "earned": self.env.earned if self._running else 0.0,
            "starting": self.starting,
            "active": self.active,
            "started": self.started,
        }

    def restore(self, table: dict[str, Any], arrays: Arrays) -> str | None:
        """The inverse of `arrays` and `table`; a note if the env does not repeat the running
        episode exactly, so that another one begins.
        """
        check(_Saved, table)
        for stream, state in zip(self.streams, table["streams"], strict=True):
            stream.bit_generator.state = state
        self.noise_state = rebuild({"noise_state": self.noise_state}, arrays)["noise_state"]
        self.starting, self.active = table["starting"], table["active"]
        self.started, self.pending = table["started"], arrays.get("pending")
        snapshot = Snapshot(table["episode"], arrays["actions"], arrays["observation"])
        if not self._running:
            self.env.episode = snapshot.episode
        elif not (self.env.restore(snapshot) and self.env.earned == table["earned"]):
            self.starting, self.pending = True, None
            return f"{self.env.name} does not repeat an episode exactly; a new one starts"
        return None
