"""One member's learner lifted over K members: the only place that knows the member axis of states.

Every random key is (stream, tick, member) folded into the run's key, so a waiting member shifts
nobody's stream and no state ever holds one.
"""

from enum import IntEnum
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pacesetter.algorithm import Algorithm, Array, Memory, State
from pacesetter.policy import OBSERVATION_LIMIT, Floats
from pacesetter.rules import Parents
from pacesetter.training.normalizer import Statistics
from pacesetter.training.replay import Columns


class Draw(IntEnum):
    """What a key is for."""

    INIT = 0
    BEGIN = 1
    ACT = 2
    UPDATE = 3


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
        self._begin = jax.jit(self._begin_all)
        self._act = jax.jit(self._act_all)
        self._update = jax.jit(self._update_all, donate_argnums=0)
        self._update_one = jax.jit(self._update_single, donate_argnums=0)
        self._inherit = jax.jit(inherit, static_argnums=2)

    def init(self, same: bool) -> State:
        """New states; `same` gives every member the same weights."""
        members = jnp.zeros(self.members, int) if same else jnp.arange(self.members)
        return self._init(self.key, members)

    def new_memory(self, states: State) -> Memory:
        """Empty memories, all to be begun."""
        shapes = jax.eval_shape(self._begin_new, states, self.key, 0)
        return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)

    def begin(self, states: State, memory: Memory, starting: list[int], tick: int) -> Memory:
        """Memories with those of the starting members made anew."""
        if not jax.tree.leaves(memory):
            return memory
        mask = np.isin(np.arange(self.members), starting)
        return self._begin(states, memory, mask, self.key, tick)

    def act(
        self, states: State, memory: Memory, observations: Floats, statistics: Statistics, tick: int
    ) -> tuple[Floats, Memory]:
        """Exploring actions (K, A) in [-1, 1]."""
        actions, memory = self._act(states, memory, observations, statistics, self.key, tick)
        return np.asarray(actions), memory

    def update(
        self,
        states: State,
        ready: list[int],
        rows: Floats,
        weight: Floats | None,
        statistics: Statistics,
        tick: int,
    ) -> tuple[State, Floats, Floats]:
        """One cycle of each ready member on its own rows (ready, U, B, width).

        All members at once, or one after the other: two programs, compiled once, for any K.
        Gives the states, losses (ready, losses) and errors (ready, U, B).
        """
        if len(ready) == self.members:
            states, losses, error = self._update(states, rows, weight, statistics, self.key, tick)
            return states, np.asarray(losses), np.asarray(error)
        parts: list[Any] = []
        for place, member in enumerate(ready):
            weights = None if weight is None else weight[place]
            states, *part = self._update_one(
                states, member, rows[place], weights, statistics, self.key, tick
            )
            parts.append(part)
        losses, errors = zip(*parts, strict=True)
        return states, np.stack(losses), np.stack(errors)

    def inherit(self, states: State, parents: Parents, copy: str) -> State:
        """States in which each member starts again from its parent."""
        return self._inherit(states, parents, copy)

    def loss_names(self, states: State) -> list[str]:
        """Names of the columns of losses, in order."""
        rows = np.zeros((self.members, self.algorithm.cycle, 1, self.columns.width), np.float32)
        statistics = (np.zeros(self.columns.observation), np.ones(self.columns.observation))
        batch = self._batch(rows, None, statistics)
        update = jax.eval_shape(
            jax.vmap(self.algorithm.update),
            states,
            batch,
            _keys(self.key, Draw.UPDATE, 0, np.arange(self.members)),
        )
        return sorted(update.losses)

    # Below: what is compiled. States, rows and so on as above; `key` is an argument so that the
    # compiled program is the same for every seed.

    def _init_all(self, key: Array, members: Array) -> State:
        return jax.vmap(self.algorithm.init)(_keys(key, Draw.INIT, 0, members))

    def _begin_new(self, states: State, key: Array, tick: int) -> Memory:
        return jax.vmap(self.algorithm.begin)(states, self._all_keys(key, Draw.BEGIN, tick))

    def _begin_all(
        self, states: State, memory: Memory, mask: Array, key: Array, tick: int
    ) -> Memory:
        def choose(new: Array, old: Array) -> Array:
            return jnp.where(_column(mask, new), new, old)

        return jax.tree.map(choose, self._begin_new(states, key, tick), memory)

    def _act_all(
        self,
        states: State,
        memory: Memory,
        observations: Array,
        statistics: Any,
        key: Array,
        tick: int,
    ) -> tuple[Array, Memory]:
        keys = self._all_keys(key, Draw.ACT, tick)
        return jax.vmap(self.algorithm.act)(
            states, memory, self._scale(observations, statistics), keys
        )

    def _update_all(
        self,
        states: State,
        rows: Array,
        weight: Array | None,
        statistics: Any,
        key: Array,
        tick: int,
    ) -> tuple[State, Array, Array]:
        keys = self._all_keys(key, Draw.UPDATE, tick)
        update = jax.vmap(self.algorithm.update)(
            states, self._batch(rows, weight, statistics), keys
        )
        losses = jnp.stack([update.losses[name] for name in sorted(update.losses)], axis=-1)
        return update.state, losses, update.error

    def _update_single(
        self,
        states: State,
        member: int,
        rows: Array,
        weight: Array | None,
        statistics: Any,
        key: Array,
        tick: int,
    ) -> tuple[State, Array, Array]:
        state = jax.tree.map(lambda x: x[member], states)
        batch = self._batch(rows, weight, statistics)
        update = self.algorithm.update(state, batch, _key(key, Draw.UPDATE, tick, member))
        states = jax.tree.map(lambda all, one: all.at[member].set(one), states, update.state)
        losses = jnp.stack([update.losses[name] for name in sorted(update.losses)])
        return states, losses, update.error

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

    def _all_keys(self, key: Array, draw: Draw, tick: int) -> Array:
        return _keys(key, draw, tick, jnp.arange(self.members))


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


def _keys(key: Array, draw: Draw, tick: Any, members: Any) -> Array:
    return jax.vmap(partial(_key, key, draw, tick))(members)
