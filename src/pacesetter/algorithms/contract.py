"""The whole contract between a learner and the trainer.

Axes: K members, U updates per call, B batch, T time, E environments, N networks in one learner.
"""

from collections.abc import Callable, Sequence
from typing import Any, ClassVar, NamedTuple, Self

import jax
import numpy as np

from pacesetter.batch import Batch, Spec
from pacesetter.errors import UsageError
from pacesetter.policy import Actors
from pacesetter.types import Floats, Layers

Array = jax.Array
State = Any  # a NamedTuple of arrays
UNROLLED = 4  # minibatches per loop iteration; XLA then need not copy the state between them


class Update(NamedTuple):
    """What one `update` gives back."""

    state: State
    losses: dict[str, Array]  # scalars; the run stops if one is not finite
    # (U, B) absolute TD errors, which a prioritised replay takes as feedback; of any shape from a
    # learner that has no replay, since nothing reads it.
    td_error: Array


class Learner:
    """One member's learner: pure functions, no env, no files. The trainer alone lifts it to K.

    A learner is a frozen dataclass of (spec, hyper). `init`, `act`, `update`, `policy_params` and
    `policy` must be given; everything else has a default here. A state is a NamedTuple that never
    holds a random key: clones that shared one would stay equal for ever.
    """

    Hyper: ClassVar[type]  # the settings class, from which flags, help and checks follow
    spec: Spec
    hyper: Any

    @classmethod
    def build(cls, spec: Spec, hyper: Any) -> Self:
        """The learner for a task and settings."""
        return cls(spec, hyper)  # pyright: ignore[reportCallIssue]

    @property
    def updates_per_call(self) -> int:
        """U, the critic updates that one call of `update` makes."""
        return 1

    def init(self, key: Array) -> State:
        """Networks, targets and optimiser state of a new learner."""
        raise NotImplementedError

    def update(self, state: State, batch: Batch, key: Array) -> Update:
        """U updates on minibatches (U, B, ...), or one update on a rollout (T, E, ...)."""
        raise NotImplementedError

    # How it acts.

    def policy_params(self, state: State) -> Any:
        """The part of a state that acting needs, which is copied to NumPy after every update."""
        raise NotImplementedError

    def start_episode(self, params: Any, rng: np.random.Generator) -> Any:
        """The noise state of a new episode, in NumPy; none by default."""
        return ()

    def act(
        self, params: Any, noise_state: Any, observation: Floats, rng: np.random.Generator
    ) -> tuple[Floats, Any]:
        """Exploring action (A,) for one observation (O,), and the next noise state.

        The trainer clips the action to [-1, 1] for the env. The replay stores it clipped, a
        rollout as it is, so that its probability can be computed. In NumPy: for one observation
        that is several times faster than calling into JAX.
        """
        raise NotImplementedError

    def policy(self, state: State) -> Actors:
        """What acts without noise, as plain arrays for the policy file."""
        raise NotImplementedError

    # What the trainer may ask besides.

    def mask(self, rng: np.random.Generator) -> Floats:
        """Bootstrap mask (N,) to store with a new transition; none by default."""
        return np.zeros(0, np.float32)

    def ledger(self, states: Sequence[State], updates: int, actions: int) -> dict[str, int]:
        """What so many updates and actions cost besides the members' own; nothing by default."""
        return {}

    def restarted(self, state: State) -> State:
        """The state of an earlier run without what it counted for its ledger (`--start-from`)."""
        return state

    def with_actor(self, state: State, layers: Layers) -> State:
        """The state with the actor of a policy file (`--start-from FILE`)."""
        raise UsageError(
            f"start_from: {type(self).__name__} cannot take the actor of a policy file; name the "
            "run that it comes from"
        )

    def blinded(self, state: State, seen: Array) -> State:
        """The state whose actor has no weight on the numbers of an observation that are not `seen`
        (O,) (`--actor-observes`); it is asked for after every update.
        """
        name = type(self).__name__
        raise UsageError(f"actor_observes: {name} cannot hide anything from its actor")

    def copy_weights(self, own: State, parent: State) -> State:
        """The parent's networks with the member's own optimiser state (`--copy weights`)."""
        raise UsageError(f"copy: {type(self).__name__} copies whole states only; allowed: full")

    def copy_actor(self, own: State, parent: State) -> State:
        """The member's own state with the parent's actor (`--copy actor`)."""
        raise UsageError(f"copy: {type(self).__name__} copies whole states only; allowed: full")


def each_minibatch(
    step: Callable[[State, Batch, Array], tuple[State, Any]],
    state: State,
    batch: Batch,
    keys: Array,
) -> tuple[State, Any]:
    """Scan `step(state, minibatch, key) -> (state, out)` over U minibatches; outs are stacked."""

    def scanned(state: State, inputs: tuple[Batch, Array]) -> tuple[State, Any]:
        return step(state, *inputs)

    return jax.lax.scan(scanned, state, (batch, keys), unroll=min(len(keys), UNROLLED))


def last_minibatch(batch: Batch) -> Batch:
    """The last of U minibatches."""
    return jax.tree.map(lambda x: x[-1], batch)
