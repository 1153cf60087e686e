"""The whole contract between an algorithm and the trainer.

Axes: K members, U updates a cycle, B batch, T time, E environments, N networks in one learner.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

import jax
import numpy as np

from pacesetter.policy import Actors, Floats

Array = jax.Array
State = Any
Memory = Any


class Spec(NamedTuple):
    """Sizes of the task's vectors; actions are in [-1, 1] on this side of the env border."""

    observation_size: int
    action_size: int


class Batch(NamedTuple):
    """What one `update` learns from: (U, B, ...) off-policy, or a rollout (T, E, ...) on-policy."""

    observation: Array
    action: Array
    reward: Array
    next_observation: Array
    discount: Array  # gamma**n * (1 - terminated)
    last: Array  # the episode ended here: terminated or truncated
    weight: Array  # importance, 1 if drawn uniformly
    mask: Array  # (..., N) bootstrap columns, stored with the row; N may be 0
    starts: Array | None = None  # reset observations, for imagined rollouts
    valid: Array | None = None  # valid rows of a padded ring


class Update(NamedTuple):
    """What one `update` gives back."""

    state: State
    losses: dict[str, Array]  # scalars; anything not finite stops the run
    error: Array  # (U, B) absolute errors, which a prioritised replay takes as feedback


NO_MASK: Floats = np.zeros(0, np.float32)


class Algorithm(Protocol):
    """One member's learner: pure functions, no env, no files. The trainer alone lifts it to K.

    A state is a NamedTuple. At its top, fields named `*_optimizer` and `updates` are its optimiser,
    and `actor` with `target_actor` and the noise `sigma` its policy, which is all that a partial
    copy needs to know. It never holds a random key: clones that shared one would stay equal for
    ever.
    """

    @property
    def cycle(self) -> int:
        """U, the critic updates of one call of `update`; 1 for a rollout."""
        ...

    def mask(self, rng: np.random.Generator) -> Floats:
        """Bootstrap mask (N,) that is stored with a new row; N may be 0."""
        ...

    def init(self, key: Array) -> State:
        """Networks, targets and optimiser of a new learner."""
        ...

    def acting(self, state: State) -> Any:
        """The part of a state that acting needs, which is copied to NumPy after every update."""
        ...

    def begin(self, acting: Any, rng: np.random.Generator) -> Memory:
        """What acting remembers within one episode, made anew at its start, in NumPy."""
        ...

    def act(
        self, acting: Any, memory: Memory, observation: Floats, rng: np.random.Generator
    ) -> tuple[Floats, Memory]:
        """Exploring action (A,) for one observation (O,); the trainer cuts it at +-1 for the env.

        The replay stores it cut, a rollout as it is, so that its probability can be computed. In
        NumPy: for one observation that is several times faster than calling into JAX.
        """
        ...

    def update(self, state: State, batch: Batch, key: Array) -> Update:
        """One cycle of U updates."""
        ...

    def ledger(self, states: Sequence[State], updates: int, actions: int) -> dict[str, int]:
        """What so many updates and chosen actions cost the members beyond themselves, for every
        row's ledger; most learners have nothing to add.
        """
        ...

    def policy(self, state: State) -> Actors:
        """What acts without noise, as plain arrays for the policy file."""
        ...
