"""The fit of a dynamics ensemble to a whole data set, in one compiled function.

A held-out part stops each member when it no longer improves, and its best networks are kept.
Recipe: ME-TRPO (Kurutach et al. 2018) and mbrl-lib; each member has its own best, as in the former.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from pacesetter.batch import Batch
from pacesetter.dynamics.model import Dynamics, Models, Networks, Scale, quantities
from pacesetter.networks.mlp import Array

TOGETHER = 50  # rows next to each other in time, nearly alike, so on one side
PARTS = 5  # of so many such blocks the last is held out
FEWEST_ROWS = TOGETHER * PARTS  # of fewer, no whole block is held out
CHECKED = 1_000  # held-out rows predicted at once
IMPROVEMENT = 0.01  # by this share of itself the loss must fall, as in mbrl-lib


class Fit(NamedTuple):
    """What a fit gives back."""

    models: Models  # each member at its own best
    loss: Array  # (K,) its mean loss on held-out rows
    epochs: Array  # that were run


class Subset(NamedTuple):
    """Chosen rows of a padded ring."""

    slots: Array  # (S,), of which `size` mean something
    size: Array

    @classmethod
    def of(cls, chosen: Array) -> "Subset":
        (slots,) = jnp.nonzero(chosen, size=len(chosen), fill_value=0)
        return cls(slots, chosen.sum())


class _Run(NamedTuple):
    models: Models
    opt_state: Any
    best: Networks
    loss: Array  # of the best
    stale: Array  # epochs since then
    epoch: Array


def fit(
    dynamics: Dynamics,
    models: Models,
    data: Batch,
    key: Array,
    batch_size: int = 256,
    patience: int = 5,
    epochs: int | Array = 100,
) -> Fit:
    """Fit all members to the first `data.valid` rows of a padded ring (S, ...), at least 250.

    The given networks are the start; Adam and the statistics begin anew. Each member draws its own
    minibatches, uniformly with replacement, and has ended when its held-out loss did not fall by
    1% for `patience` epochs; the fit ends with the last member, or after `epochs`.
    """
    rows = data._replace(starts=None, valid=None)
    in_use = jnp.arange(len(data.reward)) < (len(data.reward) if data.valid is None else data.valid)
    aside = held_out(len(data.reward))
    training, checking = Subset.of(in_use & ~aside), Subset.of(in_use & aside)
    models = models._replace(scale=measure(rows, in_use & ~aside))
    opt_state = dynamics.init_opt_state(models)
    steps = -(-training.size // batch_size)

    def minibatch(key: Array) -> Batch:
        places = jax.random.randint(key, (dynamics.members, batch_size), 0, training.size)
        return take(rows, training.slots[places])

    def epoch(run: _Run) -> _Run:
        epoch_key = jax.random.fold_in(key, run.epoch)

        def learn(step: Any, carry: tuple[Models, Any]) -> tuple[Models, Any]:
            batch = minibatch(jax.random.fold_in(epoch_key, step))
            models, opt_state, _ = dynamics.step(*carry, batch)
            return models, opt_state

        models, opt_state = jax.lax.fori_loop(0, steps, learn, (run.models, run.opt_state))
        loss = held_out_loss(dynamics, models, rows, checking)
        fell = loss + IMPROVEMENT * jnp.abs(loss) < run.loss  # a log-likelihood has any sign
        better = fell & (run.stale < patience)
        best = jax.tree.map(partial(where, better), models.networks, run.best)
        stale = jnp.where(better, 0, run.stale + 1)
        loss = jnp.where(better, loss, run.loss)
        return _Run(models, opt_state, best, loss, stale, run.epoch + 1)

    none = jnp.zeros(dynamics.members, jnp.int32)
    start = _Run(models, opt_state, models.networks, none + jnp.inf, none, jnp.zeros((), jnp.int32))
    end = jax.lax.while_loop(
        lambda run: (run.stale < patience).any() & (run.epoch < epochs), epoch, start
    )
    return Fit(models._replace(networks=end.best), end.loss, end.epoch)


def held_out(slots: int) -> Array:
    """Which slots (S,) are held out: by place, so a row never changes sides while it lives."""
    return jnp.arange(slots) // TOGETHER % PARTS == PARTS - 1


def measure(rows: Batch, chosen: Array) -> Scale:
    """Mean and variance of the chosen rows (S,)."""
    values, inside = quantities(rows), chosen[:, None]
    count = chosen.sum()
    mean = jnp.where(inside, values, 0).sum(axis=0) / count
    variance = jnp.where(inside, (values - mean) ** 2, 0).sum(axis=0) / count
    return Scale(mean, variance, jnp.zeros((), jnp.int32))


def held_out_loss(dynamics: Dynamics, models: Models, rows: Batch, part: Subset) -> Array:
    """Mean loss (K,) over the rows of a subset, so many at once."""

    def add(index: Array, total: Array) -> Array:
        places = index * CHECKED + jnp.arange(CHECKED)
        batch = take(rows, part.slots[places])._replace(weight=1.0 * (places < part.size))
        every = jax.tree.map(lambda x: jnp.stack([x] * dynamics.members), batch)
        return total + CHECKED * dynamics.losses(models.networks, models.scale, every)

    rounds = -(-part.size // CHECKED)
    return jax.lax.fori_loop(0, rounds, add, jnp.zeros(dynamics.members)) / part.size


def take(rows: Batch, slots: Array) -> Batch:
    """Rows by their slots."""
    return jax.tree.map(lambda x: x[slots], rows)


def where(chosen: Array, new: Array, old: Array) -> Array:
    """New values for the chosen members (K,), old ones for the rest."""
    return jnp.where(chosen.reshape(-1, *(1,) * (new.ndim - 1)), new, old)
