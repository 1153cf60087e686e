"""One learner compiled once and called for each of K members, whose states are a plain list.

Members share a program, not a call. One member alone is faster than under `vmap`, and several in
threads keep more of the cores busy than one product that is split over the cores.
Every random key folds (purpose, number of the member's call, member) into the run's key, so a
waiting member shifts nobody's stream and no state ever holds a key.
"""

from collections.abc import Sequence
from enum import IntEnum
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray
from optax import incremental_update

from pacesetter.algorithms.contract import Array, Learner, State
from pacesetter.batch import Layout
from pacesetter.learner import products
from pacesetter.learner.normalizer import Statistics
from pacesetter.learner.precision import bfloat16_products
from pacesetter.learner.scales import scaled
from pacesetter.policy import OBSERVATION_LIMIT
from pacesetter.seeding import Stream, generator
from pacesetter.settings.values import chosen
from pacesetter.types import Floats

KEYS = 1024  # made in one call: in the update itself they would come before every product


class KeyUse(IntEnum):
    """What a key is for."""

    INIT = 0
    UPDATE = 1


class UpdateInputs(NamedTuple):
    """What one call of a member's update takes besides its state."""

    call: int
    rows: Floats  # (U, B, width)
    weight: Floats | None
    statistics: Statistics
    extra: dict[str, Any] | None = None  # fields of the batch that are not in rows
    scales: dict[str, float] | None = None  # factors of settings that differ between members


class MemberUpdate(NamedTuple):
    """What one call of a member's update gave."""

    state: State
    losses: Floats  # (losses,)
    td_error: Array  # (U, B)
    policy_params: Any  # what it acts with now


class CompiledLearner:
    """The compiled functions of one learner: the same program for every member and seed."""

    def __init__(
        self,
        learner: Learner,
        layout: Layout,
        seed: int,
        normalize: bool,
        precision: str = "f32",
        seen: NDArray[np.bool_] | None = None,
    ) -> None:
        """`seen` (O,) tells what the actor sees of an observation; None is all of it."""
        self.learner, self.layout = learner, layout
        self.key = jax.random.key(seed)
        self._init = jax.jit(lambda key, member: learner.init(_key(key, KeyUse.INIT, 0, member)))
        self._policy_params = jax.jit(learner.policy_params)
        self._actors = jax.jit(lambda state: learner.policy(state).layers)
        self._ema_actors = jax.jit(
            lambda ema, state, tau: incremental_update(learner.policy(state).layers, ema, tau)
        )
        self._keys = lru_cache(maxsize=1024)(partial(_keys_of, jax.jit(_fold_keys), self.key))
        self._program = _Program(learner, layout, normalize, jax.random.key_impl(self.key), seen)
        update = self._program.update
        if precision == "bf16":
            update = bfloat16_products(update)
        self._update = jax.jit(products.by_library(update, precision), donate_argnums=0)

    def init(self, members: int, same: bool) -> list[State]:
        """New states; `same` gives every member the same weights."""
        return [self._init(self.key, 0 if same else member) for member in range(members)]

    def blinded(self, state: State) -> State:
        """A state whose actor sees no more than it may; each update gives such a one."""
        return self._program.blinded(state)

    def policy_params(self, states: Sequence[State]) -> list[Any]:
        """What each member acts with, as NumPy arrays that no later update touches."""
        return [jax.tree.map(np.array, self._policy_params(state)) for state in states]

    def update(self, state: State, member: int, inputs: UpdateInputs) -> MemberUpdate:
        """One call of a member's update; the given state is used up.

        Members may be called from threads.
        """
        call, rows, weight, statistics, extra, scales = inputs
        key = self._keys(member, call // KEYS)[call % KEYS]
        data = (rows, weight, statistics, extra or {}, scales or {})
        state, losses, td_error, params = self._update(state, *data, key)
        return MemberUpdate(
            state, np.asarray(losses), td_error, params
        )  # NumPy waits for the result

    def loss_names(self, state: State, inputs: UpdateInputs) -> list[str]:
        """Names of the losses, in order, for the inputs of an update; only their shapes matter."""

        def losses(state: State, rows: Array, extra: dict[str, Any]) -> dict[str, Array]:
            batch = self._program.batch(rows, inputs.weight, inputs.statistics, extra)
            return self.learner.update(state, batch, self.key).losses

        return sorted(jax.eval_shape(losses, state, inputs.rows, inputs.extra or {}))

    def actors(self, state: State) -> Any:
        """The layers of what acts without noise."""
        return self._actors(state)

    def ema_actors(self, ema: Any, state: State, tau: float) -> Any:
        """Such layers, a step of size `tau` nearer to what they are in a state now."""
        return self._ema_actors(ema, state, tau)


class _Program(NamedTuple):
    """What is compiled: a pure function of its arguments, the same for every seed.

    It knows nothing of who compiles it: a circle would keep programs, which are large, in memory.
    """

    learner: Learner
    layout: Layout
    normalize: bool
    impl: Any  # of the random keys
    seen: NDArray[np.bool_] | None  # what the actor sees of an observation (O,), None all

    def update(
        self,
        state: State,
        rows: Array,
        weight: Array | None,
        statistics: Any,
        extra: dict[str, Any],
        scales: dict[str, Array],
        key: Array,
    ) -> tuple[State, Array, Array, Any]:
        """A member's state after one call, its losses, its TD errors, and what it acts with."""
        batch = self.batch(rows, weight, statistics, extra)
        whole = jax.random.wrap_key_data(key, impl=self.impl)
        learner = scaled(self.learner, scales) if scales else self.learner
        if "gamma" in scales:  # rows hold the discount of the run's own gamma
            share = learner.hyper.gamma / self.learner.hyper.gamma
            batch = batch._replace(discount=batch.discount * share)
        update = learner.update(state, batch, whole)
        losses = jnp.stack([update.losses[name] for name in sorted(update.losses)])
        # Buffers of their own: a state that NumPy looks into cannot be donated without a copy.
        after = self.blinded(update.state)
        params = jax.tree.map(jnp.copy, self.learner.policy_params(after))
        return after, losses, update.td_error, params

    def blinded(self, state: State) -> State:
        """Weights are set to 0 after a step, not gradients before it: Adam moves each weight by its
        own gradient alone, so the others learn the same. (With crossq's --weight-norm nearly so:
        the length of a unit's weights counts the step of those.)
        """
        return state if self.seen is None else self.learner.blinded(state, jnp.asarray(self.seen))

    def batch(self, rows: Any, weight: Any, statistics: Any, extra: dict[str, Any]) -> Any:
        """Rows (U, B, width) as a batch that the learner takes."""
        batch = self.layout.unpack(rows)
        batch = batch._replace(
            weight=jnp.ones(rows.shape[:-1]) if weight is None else weight,
            observation=self._scale(batch.observation, statistics),
            next_observation=self._scale(batch.next_observation, statistics),
            **extra,
        )
        if batch.return_deviation is None:
            return batch
        return batch._replace(reward=batch.reward / batch.return_deviation, return_deviation=None)

    def _scale(self, observation: Array, statistics: Any) -> Array:
        if not self.normalize:
            return observation
        mean, deviation = statistics
        return jnp.clip((observation - mean) / deviation, -OBSERVATION_LIMIT, OBSERVATION_LIMIT)


def _keys_of(fold: Any, key: Array, member: int, block: int) -> Any:
    return np.asarray(fold(key, np.uint32(block * KEYS), member))


def _fold_keys(key: Array, first: Any, member: Any) -> Array:
    calls = first + jnp.arange(KEYS, dtype=jnp.uint32)
    keys = jax.vmap(lambda call: _key(key, KeyUse.UPDATE, call, member))(calls)
    return jax.random.key_data(keys)


def of_transitions(learner: Learner, seed: int) -> CompiledLearner:
    """The program of a learner on a replay, whose rows have the masks that it wants."""
    hyper, masks = learner.hyper, len(learner.mask(generator(0, Stream.MASK)))
    layout = Layout(learner.spec, masks=masks)
    words, size = hyper.actor_observes, learner.spec.observation_size
    seen = None if words is None else np.array(chosen("actor_observes", words, size))
    return CompiledLearner(
        learner, layout, seed, hyper.normalize_observation, hyper.precision, seen
    )


def _key(key: Array, use: KeyUse, call: Any, member: Any) -> Array:
    for number in (int(use), call, member):
        key = jax.random.fold_in(key, number)
    return key
