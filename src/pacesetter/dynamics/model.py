"""A learned model of the task: K networks that predict how the state changes, on scaled inputs.

    s' = s + mean + deviation * change_k((s, a) in deviations)

A member is one change network and one termination head; reward heads are an ensemble of their
own, since STEVE combines each with each. Known functions of the task (known_rewards.py) replace
the heads.
A pure function of pytrees each; recipes: STEVE (Buckman et al. 2018), ME-TRPO (Kurutach et al.
2018) and, for the Gaussian form, PETS (Chua et al. 2018) as in mbrl-lib.

Axes: K members, N reward heads, B rows, O and A numbers of a state and of an action.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from pacesetter.batch import Batch, Spec
from pacesetter.networks import mlp
from pacesetter.networks.mlp import Array
from pacesetter.policy import OBSERVATION_LIMIT

LOG_VARIANCE_RANGE = (-10.0, 0.5)  # of the scaled change, as in mbrl-lib
SMALLEST_DEVIATION = 1e-3  # numbers that never change are not blown up
SLOWEST = 1e-3  # share of a minibatch in the moving statistics


class Known(NamedTuple):
    """What the task's maker tells: functions of arrays with any leading axes, for compilation.

    Observations are raw; actions are in [-1, 1], as everywhere on this side of the env border.
    """

    reward: Callable[[Array, Array, Array], Array]  # (s, a, s') -> (...)
    terminated: Callable[[Array], Array]  # s' -> (...) bool


class Form(NamedTuple):
    """How a change network's outputs are read."""

    outputs: int  # to a number
    read: Callable[[Array], tuple[Array, Array]]  # outputs -> mean and log-variance, each (..., O)
    loss: Callable[[Array, Array, Array], Array]  # mean, log-variance, truth -> (..., O)


def bounded(raw: Array) -> Array:
    """A log-variance kept softly in its range: near the identity inside, with slope everywhere."""
    low, high = LOG_VARIANCE_RANGE
    below = high - jax.nn.softplus(high - raw)
    return low + jax.nn.softplus(below - low)


def _read_gaussian(outputs: Array) -> tuple[Array, Array]:
    mean, raw = jnp.split(outputs, 2, axis=-1)
    return mean, bounded(raw)


# A variance of zero: `sample` then is the mean.
DETERMINISTIC = Form(
    1,
    lambda outputs: (outputs, jnp.full_like(outputs, -jnp.inf)),
    lambda mean, log_variance, truth: 0.5 * (mean - truth) ** 2,
)
GAUSSIAN = Form(
    2,
    _read_gaussian,
    lambda mean, log_variance, truth: (
        0.5 * ((mean - truth) ** 2 * jnp.exp(-log_variance) + log_variance)
    ),
)


class Networks(NamedTuple):
    """Layers with a leading axis of members; an empty tuple where the task's function is known."""

    change: mlp.Network
    reward: mlp.Network
    terminated: mlp.Network


class Scale(NamedTuple):
    """Mean and variance (2 O + A + 1,) of state, action, change of state and reward."""

    mean: Array
    variance: Array
    taken: Array  # minibatches so far

    @property
    def deviation(self) -> Array:
        return jnp.maximum(jnp.sqrt(self.variance), SMALLEST_DEVIATION)


class Models(NamedTuple):
    """All that is learned; `networks` alone is moved by gradients."""

    networks: Networks
    scale: Scale


@dataclass(frozen=True)
class Dynamics:
    """An ensemble of models; `known` replaces the learned heads."""

    spec: Spec
    members: int = 4
    hidden: tuple[int, ...] = (256, 256)
    head_hidden: tuple[int, ...] = (64, 64)
    form: Form = DETERMINISTIC
    known: Known | None = None
    learning_rate: float = 1e-3
    decay: float = 0.0

    def init(self, key: Array) -> Models:
        """New networks, unlike each other, and no statistics yet."""
        observation, action = self.spec
        pair, triple = observation + action, 2 * observation + action

        def new(key: Array) -> Networks:
            keys = jax.random.split(key, 3)
            heads = () if self.known else (self._head(keys[1], triple), self._head(keys[2], triple))
            outputs = self.form.outputs * observation
            return Networks(mlp.init(keys[0], pair, self.hidden, outputs), *(heads or ((), ())))

        size = triple + 1
        scale = Scale(jnp.zeros(size), jnp.ones(size), jnp.zeros((), jnp.int32))
        return Models(jax.vmap(new)(jax.random.split(key, self.members)), scale)

    def init_opt_state(self, models: Models) -> Any:
        """Adam's opt_state of all networks."""
        return self._adam.init(models.networks)

    def choose(self, models: Models, member: Array | int) -> Models:
        """One member alone, as an ensemble of one (K = 1)."""
        return models._replace(networks=jax.tree.map(lambda x: x[member][None], models.networks))

    # What the models say. Arguments (K, B, ...): each member has states of its own.

    def predict(self, models: Models, observation: Array, action: Array) -> tuple[Array, Array]:
        """Mean and deviation (K, B, O) of each member's next observation."""
        inputs = self._scaled(models.scale, observation, action)
        outputs = jax.vmap(mlp.apply)(models.networks.change, inputs)
        mean, log_variance = self.form.read(outputs)
        centre, deviation = self._of_change(models.scale)
        next_observation = observation + centre + deviation * mean
        return next_observation, deviation * jnp.exp(0.5 * log_variance)

    def sample(self, models: Models, observation: Array, action: Array, key: Array) -> Array:
        """A next observation (K, B, O) of each member; the mean if the form is deterministic."""
        mean, deviation = self.predict(models, observation, action)
        return mean + deviation * jax.random.normal(key, mean.shape)

    def reward(
        self, models: Models, observation: Array, action: Array, next_observation: Array
    ) -> Array:
        """What every reward head says (N, ...) of transitions (...); N is 1 if it is known."""
        if self.known:
            return self.known.reward(observation, action, next_observation)[None]
        inputs = self._scaled(models.scale, observation, action, next_observation - observation)
        scaled = jax.vmap(mlp.apply, (0, None))(models.networks.reward, inputs)[..., 0]
        return models.scale.mean[-1] + models.scale.deviation[-1] * scaled

    def terminated(
        self, models: Models, observation: Array, action: Array, next_observation: Array
    ) -> Array:
        """Each member's probability (K, B) that its own transition ends the task."""
        if self.known:
            return self.known.terminated(next_observation).astype(next_observation.dtype)
        inputs = self._scaled(models.scale, observation, action, next_observation - observation)
        return jax.nn.sigmoid(jax.vmap(mlp.apply)(models.networks.terminated, inputs)[..., 0])

    # How they learn.

    def observe(self, models: Models, batch: Batch) -> Models:
        """Take a minibatch into the statistics: first a mean of all, later a moving one."""
        scale, values = models.scale, quantities(batch).reshape(-1, models.scale.mean.size)
        taken = scale.taken + 1
        share = jnp.maximum(1 / taken, SLOWEST)
        change = values.mean(axis=0) - scale.mean
        spread = values.var(axis=0) + (1 - share) * change**2
        mean = scale.mean + share * change
        variance = scale.variance + share * (spread - scale.variance)
        return models._replace(scale=Scale(mean, variance, taken))

    def losses(self, networks: Networks, scale: Scale, batch: Batch) -> Array:
        """Mean loss (K,) of each member on its own rows (K, B, ...), by their weight."""
        truth = (quantities(batch) - scale.mean) / scale.deviation
        pair = sum(self.spec)
        inputs, change = cut(truth[..., :pair]), truth[..., pair:-1]
        predicted = self.form.read(jax.vmap(mlp.apply)(networks.change, inputs))
        rows = self.form.loss(*predicted, change).sum(axis=-1)
        if not self.known:
            triple = cut(truth[..., :-1])
            reward = jax.vmap(mlp.apply)(networks.reward, triple)[..., 0]
            logit = jax.vmap(mlp.apply)(networks.terminated, triple)[..., 0]
            # The discount alone would call every transition an end where gamma is 0.
            ended = ((batch.discount == 0) & (batch.last > 0)).astype(logit.dtype)
            rows += 0.5 * (reward - truth[..., -1]) ** 2
            rows += optax.sigmoid_binary_cross_entropy(logit, ended)
        return (batch.weight * rows).mean(axis=-1)

    def step(self, models: Models, opt_state: Any, batch: Batch) -> tuple[Models, Any, Array]:
        """One Adam step of every member on its own rows (K, B, ...); the mean loss."""

        def loss(networks: Networks) -> Array:
            return self.losses(networks, models.scale, batch).sum()

        value, gradient = jax.value_and_grad(loss)(models.networks)
        networks, opt_state = mlp.apply_gradient(self._adam, models.networks, gradient, opt_state)
        return models._replace(networks=networks), opt_state, value / self.members

    def _of_change(self, scale: Scale) -> tuple[Array, Array]:
        """Mean and deviation (O,) of the change of state."""
        part = slice(sum(self.spec), -1)
        return scale.mean[part], scale.deviation[part]

    def _scaled(self, scale: Scale, *parts: Array) -> Array:
        """Inputs from state, action and, for heads, change, in deviations."""
        values = jnp.concatenate(parts, axis=-1)
        size = values.shape[-1]
        return cut((values - scale.mean[:size]) / scale.deviation[:size])

    def _head(self, key: Array, inputs: int) -> mlp.Network:
        return mlp.init(key, inputs, self.head_hidden, 1)

    @property
    def _adam(self) -> optax.GradientTransformation:
        return mlp.adam(self.learning_rate, self.decay)


def quantities(batch: Batch) -> Array:
    """What `Scale` knows mean and variance of: state, action, change, reward (..., 2 O + A + 1)."""
    change = batch.next_observation - batch.observation
    parts = [batch.observation, batch.action, change, batch.reward[..., None]]
    return jnp.concatenate(parts, axis=-1)


def cut(scaled: Array) -> Array:
    """Inputs that are nowhere far from the data, so that imagined states cannot run away."""
    return jnp.clip(scaled, -OBSERVATION_LIMIT, OBSERVATION_LIMIT)
