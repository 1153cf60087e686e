"""One member's learner lifted over K members: the only place that knows the member axis of states.

Every random key is (purpose, the member's own count of cycles, member) folded into the run's key,
so a waiting member shifts nobody's stream and no state ever holds a key.
"""

from enum import IntEnum
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from pacesetter.algorithm import Algorithm, Array, State
from pacesetter.policy import OBSERVATION_LIMIT, Floats
from pacesetter.rules import Parents
from pacesetter.training.normalizer import Statistics
from pacesetter.training.replay import Columns


class Draw(IntEnum):
    """What a key is for."""

    INIT = 0
    UPDATE = 1


class Cycle(NamedTuple):
    """What a cycle of the ready members gave."""

    states: State  # of all members
    losses: Floats  # (ready, losses)
    error: Floats  # (ready, U, B)
    acting: list[Any]  # what each ready member acts with now


class Population:
    """Compiled functions over states whose leaves carry a leading axis of K members."""

    def __init__(
        self,
        algorithm: Algorithm,
        columns: Columns,
        members: int,
        seed: int,
        normalize: bool,
    ) -> None:
        self.algorithm, self.columns, self.members = algorithm, columns, members
        self.normalize = normalize
        self.key = jax.random.key(seed)
        self._init = jax.jit(self._init_all)
        self._acting = jax.jit(algorithm.acting)
        self._update = jax.jit(self._update_all, donate_argnums=0)
        self._update_one = jax.jit(self._update_single, donate_argnums=0)
        self._inherit = jax.jit(inherit, static_argnums=2)

    def init(self, same: bool) -> State:
        """New states; `same` gives every member the same weights."""
        members = jnp.zeros(self.members, int) if same else jnp.arange(self.members)
        return self._init(self.key, members)

    def acting(self, states: State) -> list[Any]:
        """What each member acts with, as NumPy copies."""
        return self._each(self._acting(states))

    def update(
        self,
        states: State,
        ready: list[int],
        rows: Floats,
        weight: Floats | None,
        statistics: Statistics,
        ticks: list[int],
    ) -> Cycle:
        """One cycle of each ready member on its own rows (ready, U, B, width).

        All members at once, or one after the other: two programs, compiled once, for any K.
        """
        if len(ready) == self.members:
            states, losses, error, acting = self._update(
                states, rows, weight, statistics, self.key, np.array(ticks, np.uint32)
            )
            return Cycle(states, np.asarray(losses), np.asarray(error), self._each(acting))
        parts: list[Any] = []
        for place, member in enumerate(ready):
            weights = None if weight is None else weight[place]
            states, *part = self._update_one(
                states, member, rows[place], weights, statistics, self.key, ticks[place]
            )
            parts.append(part)
        losses, errors, acting = zip(*parts, strict=True)
        return Cycle(
            states,
            np.stack(losses),
            np.stack(errors),
            [jax.tree.map(np.asarray, part) for part in acting],
        )

    def inherit(self, states: State, parents: Parents, copy: str) -> State:
        """States in which each member starts again from its parent."""
        return self._inherit(states, parents, copy)

    def loss_names(self, states: State) -> list[str]:
        """Names of the columns of losses, in order."""
        members = jnp.arange(self.members)
        rows = np.zeros((self.members, self.algorithm.cycle, 1, self.columns.width), np.float32)
        size = self.columns.observation
        batch = self._batch(rows, None, (np.zeros(size), np.ones(size)))
        keys = _keys(self.key, Draw.UPDATE, members, members)
        return sorted(jax.eval_shape(jax.vmap(self.algorithm.update), states, batch, keys).losses)

    # Below: what is compiled. States, rows and so on as above; `key` is an argument so that the
    # compiled program is the same for every seed.

    def _init_all(self, key: Array, members: Array) -> State:
        return jax.vmap(self.algorithm.init)(
            _keys(key, Draw.INIT, jnp.zeros_like(members), members)
        )

    def _update_all(
        self,
        states: State,
        rows: Array,
        weight: Array | None,
        statistics: Any,
        key: Array,
        ticks: Array,
    ) -> tuple[State, Array, Array, Any]:
        keys = _keys(key, Draw.UPDATE, ticks, jnp.arange(self.members))
        update = jax.vmap(self.algorithm.update)(
            states, self._batch(rows, weight, statistics), keys
        )
        losses = jnp.stack([update.losses[name] for name in sorted(update.losses)], axis=-1)
        return update.state, losses, update.error, self._apart(update.state)

    def _update_single(
        self,
        states: State,
        member: int,
        rows: Array,
        weight: Array | None,
        statistics: Any,
        key: Array,
        tick: int,
    ) -> tuple[State, Array, Array, Any]:
        state = jax.tree.map(lambda x: x[member], states)
        batch = self._batch(rows, weight, statistics)
        update = self.algorithm.update(state, batch, _key(key, Draw.UPDATE, tick, member))
        states = jax.tree.map(lambda all, one: all.at[member].set(one), states, update.state)
        losses = jnp.stack([update.losses[name] for name in sorted(update.losses)])
        return states, losses, update.error, self._apart(update.state)

    def _apart(self, state: State) -> Any:
        """Buffers of their own: a state that NumPy looks into cannot be donated without a copy."""
        return jax.tree.map(jnp.copy, self.algorithm.acting(state))

    def _each(self, acting: Any) -> list[Any]:
        arrays = jax.tree.map(np.asarray, acting)
        return [jax.tree.map(lambda x, k=k: x[k], arrays) for k in range(self.members)]

    def _batch(self, rows: Any, weight: Any, statistics: Any) -> Any:
        batch = self.columns.unpack(rows, weight)
        return batch._replace(
            observation=self._scale(batch.observation, statistics),
            next_observation=self._scale(batch.next_observation, statistics),
        )

    def _scale(self, observation: Array, statistics: Any) -> Array:
        if not self.normalize:
            return observation
        mean, deviation = statistics
        return jnp.clip((observation - mean) / deviation, -OBSERVATION_LIMIT, OBSERVATION_LIMIT)


def inherit(states: Any, parents: Array, copy: str) -> Any:
    """Each member's new state: `full` copies all of its parent's, `weights` leaves it its own
    optimiser, `actor` gives it the parent's actor, as its target too, with fresh Adam moments.
    """
    taken = jax.tree.map(lambda x: x[parents], states)
    if copy == "full":
        return taken
    if copy == "weights":
        own = [f for f in states._fields if f.endswith("_optimizer") or f == "updates"]
        new = taken._replace(**{field: getattr(states, field) for field in own})
    else:
        fresh = jax.tree.map(jnp.zeros_like, states.actor_optimizer)
        new = states._replace(actor=taken.actor, actor_optimizer=fresh)
        if "target_actor" in states._fields:
            new = new._replace(target_actor=taken.actor)
    stays = parents == jnp.arange(len(parents))
    return jax.tree.map(
        lambda own, copied: jnp.where(_column(stays, own), own, copied), states, new
    )


def _column(mask: Array, like: Array) -> Array:
    return mask.reshape((-1,) + (1,) * (like.ndim - 1))


def _key(key: Array, draw: Draw, tick: Any, member: Any) -> Array:
    for number in (int(draw), tick, member):
        key = jax.random.fold_in(key, number)
    return key


def _keys(key: Array, draw: Draw, ticks: Any, members: Any) -> Array:
    return jax.vmap(partial(_key, key, draw))(ticks, members)
