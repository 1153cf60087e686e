"""TD7 (Fujimoto et al. 2023), one member. Reference: sfujim/TD7, TD7.py at b7c8cd3.

TD3 whose networks also see learned embeddings, from encoders that predict the next state's:

zs = state_encoder(s), zsa = action_encoder(zs, a)
for each of `policy_delay` minibatches:
    move the encoder's zsa towards its zs of s'
    next_q = min_i target_critic_i(s', a', target_encoder), a' = target_actor(s') + clipped noise
    target_q = r + discount * next_q, next_q clipped to the range of all targets up to the last copy
    move every critic(s, a, fixed_encoder) towards target_q, by LAP's loss
move the actor up the mean of the critics on the last minibatch
every `copy_every` updates: the targets become the networks, the target encoder the fixed one, and
the fixed one the encoder
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, Literal, NamedTuple

import jax
import jax.numpy as jnp
import optax
from pydantic import Field
from pydantic.dataclasses import dataclass as settings

from pacesetter.algorithms.contract import Array, Learner, Update, each_minibatch, last_minibatch
from pacesetter.algorithms.deterministic import DeterministicLearner
from pacesetter.batch import Batch, Spec
from pacesetter.errors import UsageError
from pacesetter.networks import critic_heads, mlp, sale
from pacesetter.settings import STRICT, OffPolicy
from pacesetter.settings.values import LearningRate, SmallCount, Width

FAR = 1e8  # beyond every target: where the smallest and largest one seen begin


@settings(frozen=True, kw_only=True, config=STRICT)
class Hyper(OffPolicy):
    """Defaults are the reference repository's; noise is in units of actions in [-1, 1]."""

    replay: Literal["uniform", "prioritized", "lap", "return"] = Field(
        "lap",
        description="sample transitions uniformly, by TD error (PER or LAP) or by episode return",
    )
    assess: int = Field(
        20,
        ge=0,
        description="training episodes that a policy plays unchanged before it may become the"
        " one that is evaluated, 20 in TD7; 0 disables it",
    )
    hidden: tuple[Width, ...] = Field(
        (256, 256),
        min_length=1,
        description="widths of hidden layers of actor and critics, behind a first one as wide",
    )
    encoder_hidden: tuple[Width, Width] = Field(
        (256, 256), description="widths of the two hidden layers of each encoder"
    )
    encoder_size: Width = Field(256, description="numbers in an embedding")
    actor_learning_rate: LearningRate = Field(
        3e-4, gt=0, description="Adam learning rate of the actor"
    )
    critic_learning_rate: LearningRate = Field(
        3e-4, gt=0, description="Adam learning rate of the critics"
    )
    encoder_learning_rate: LearningRate = Field(
        3e-4, gt=0, description="Adam learning rate of the encoders"
    )
    critics: int = Field(2, ge=1, le=100, description="critics; the target uses their minimum")
    policy_delay: int = Field(2, ge=1, le=1_000, description="critic updates per actor update")
    copy_every: SmallCount = Field(250, description="critic updates between copies to the targets")
    target_noise: float = Field(
        0.2, ge=0, description="standard deviation of the target action's noise"
    )
    target_noise_clip: float = Field(0.5, ge=0, description="bound of the target action's noise")
    exploration: Literal["gaussian", "ou", "sparse"] = Field(
        "gaussian", description="kind of noise on actions"
    )
    exploration_noise: float = Field(0.1, ge=0, description="standard deviation of that noise")


class State(NamedTuple):
    """One learner; critics carry a leading axis of `critics`."""

    actor: mlp.Network
    critic: mlp.Network
    encoder: sale.Encoder
    fixed_encoder: sale.Encoder  # what actor and critics see
    target_actor: mlp.Network
    target_critic: mlp.Network
    target_encoder: sale.Encoder
    actor_opt_state: Any
    critic_opt_state: Any
    encoder_opt_state: Any
    updates: Array
    seen: Array  # smallest and largest target so far
    value_range: Array  # the same at the last copy
    exploration: Any = ()


@dataclass(frozen=True)
class TD7(DeterministicLearner):
    """The learner of one member."""

    Hyper: ClassVar[type] = Hyper
    spec: Spec
    hyper: Any

    @cached_property
    def head(self) -> critic_heads.Head:
        """What the critics' outputs mean."""
        return critic_heads.choose(0, self.hyper.replay)

    @property
    def updates_per_call(self) -> int:
        return self.hyper.policy_delay

    def init(self, key: Array) -> State:
        actor_key, critic_key, encoder_key = jax.random.split(key, 3)
        observation, action = self.spec
        hyper = self.hyper
        size = hyper.encoder_size
        actor = sale.init(actor_key, observation, size, hyper.hidden, action)

        def new_critic(key: Array) -> mlp.Network:
            return sale.init(key, observation + action, 2 * size, hyper.hidden, 1)

        critic = jax.vmap(new_critic)(jax.random.split(critic_key, hyper.critics))
        encoder = sale.init_encoder(encoder_key, self.spec, hyper.encoder_hidden, size)
        copies = [jax.tree.map(jnp.copy, net) for net in (encoder, actor, critic, encoder)]
        fixed_encoder, target_actor, target_critic, target_encoder = copies
        return State(
            actor=actor,
            critic=critic,
            encoder=encoder,
            fixed_encoder=fixed_encoder,
            target_actor=target_actor,
            target_critic=target_critic,
            target_encoder=target_encoder,
            actor_opt_state=optax.adam(hyper.actor_learning_rate).init(actor),
            critic_opt_state=optax.adam(hyper.critic_learning_rate).init(critic),
            encoder_opt_state=optax.adam(hyper.encoder_learning_rate).init(encoder),
            updates=jnp.zeros((), jnp.int32),
            seen=jnp.array([FAR, -FAR]),
            value_range=jnp.zeros(2),
        )

    # One update.

    def update(self, state: State, batch: Batch, key: Array) -> Update:
        keys = jax.random.split(key, self.updates_per_call)
        state, (losses, td_error) = each_minibatch(self.critic_step, state, batch, keys)
        state, actor_loss = self.fit_actor(state, last_minibatch(batch))
        losses = {name: loss.mean() for name, loss in losses.items()}
        return Update(self.update_targets(state), losses | {"actor_loss": actor_loss}, td_error)

    def critic_step(self, state: State, batch: Batch, key: Array) -> tuple[State, Any]:
        """Move the encoder, then every critic towards the target of one minibatch."""
        state, encoder_loss = self.fit_encoder(state, batch)
        target_q = self.target(state, batch, key)
        low, high = state.seen
        seen = jnp.stack([jnp.minimum(low, target_q.min()), jnp.maximum(high, target_q.max())])
        state, loss, td_error = self.fit_critic(state._replace(seen=seen), batch, target_q)
        return state, ({"critic_loss": loss, "encoder_loss": encoder_loss}, td_error)

    def fit_encoder(self, state: State, batch: Batch) -> tuple[State, Array]:
        """One Adam step of the encoder: the embedding of (s, a) predicts that of s'."""
        wanted = sale.zs(state.encoder, batch.next_observation)

        def loss(encoder: sale.Encoder) -> Array:
            zs = sale.zs(encoder, batch.observation)
            return ((sale.zsa(encoder, zs, batch.action) - wanted) ** 2).mean()

        value, gradient = jax.value_and_grad(loss)(state.encoder)
        adam = optax.adam(self.hyper.encoder_learning_rate)
        encoder, opt_state = mlp.apply_gradient(
            adam, state.encoder, gradient, state.encoder_opt_state
        )
        return state._replace(encoder=encoder, encoder_opt_state=opt_state), value

    def target(self, state: State, batch: Batch, key: Array) -> Array:
        """Clipped double-Q target (B,), of a next value within the range of earlier targets."""
        encoder, observation = state.target_encoder, batch.next_observation
        zs = sale.zs(encoder, observation)
        action = self.smoothed(sale.action(state.target_actor, observation, zs), key)
        next_q = critic_heads.min_q(
            self.values(state.target_critic, encoder, observation, zs, action)
        )
        return batch.reward + batch.discount * jnp.clip(next_q, *state.value_range)

    def fit_critic(self, state: State, batch: Batch, target_q: Array) -> tuple[State, Array, Array]:
        """One Adam step of all critics; the loss and each transition's largest |TD error| (B,)."""
        zs = sale.zs(state.fixed_encoder, batch.observation)
        zsa = sale.zsa(state.fixed_encoder, zs, batch.action)

        def loss(critic: mlp.Network) -> tuple[Array, Array]:
            outputs = mlp.each(sale.outputs, critic, batch.observation, batch.action, zsa, zs)
            return self.head.weighted_loss(outputs, target_q, batch.weight)

        (value, td_error), gradient = jax.value_and_grad(loss, has_aux=True)(state.critic)
        adam = optax.adam(self.hyper.critic_learning_rate)
        critic, opt_state = mlp.apply_gradient(adam, state.critic, gradient, state.critic_opt_state)
        state = state._replace(critic=critic, critic_opt_state=opt_state, updates=state.updates + 1)
        return state, value, td_error

    def fit_actor(self, state: State, batch: Batch) -> tuple[State, Array]:
        """One Adam step of the actor up the mean of all critics."""
        observation, encoder = batch.observation, state.fixed_encoder
        zs = sale.zs(encoder, observation)

        def loss(actor: mlp.Network) -> Array:
            action = sale.action(actor, observation, zs)
            return -self.values(state.critic, encoder, observation, zs, action).mean()

        value, gradient = jax.value_and_grad(loss)(state.actor)
        adam = optax.adam(self.hyper.actor_learning_rate)
        actor, opt_state = mlp.apply_gradient(adam, state.actor, gradient, state.actor_opt_state)
        return state._replace(actor=actor, actor_opt_state=opt_state), value

    def update_targets(self, state: State) -> State:
        """The state with its targets renewed, if `copy_every` critic updates have passed.

        The reference does so at that very update; here the cycle of `policy_delay` is finished.
        """
        renewed = {
            "target_actor": state.actor,
            "target_critic": state.critic,
            "target_encoder": state.fixed_encoder,
            "fixed_encoder": state.encoder,
            "value_range": state.seen,
        }
        kept = {name: getattr(state, name) for name in renewed}
        due = state.updates % self.hyper.copy_every < self.updates_per_call
        return state._replace(**jax.lax.cond(due, lambda: renewed, lambda: kept))

    def values(
        self, critic: mlp.Network, encoder: sale.Encoder, observation: Array, zs: Array, action: Any
    ) -> Array:
        """Every critic's value (critics, B) of actions in states with embeddings zs."""
        zsa = sale.zsa(encoder, zs, action)
        return mlp.each(sale.outputs, critic, observation, action, zsa, zs)[..., 0]

    # How it acts, and what is copied.

    def policy_params(self, state: State) -> tuple[mlp.Network, Any]:
        return sale.with_encoder(state.actor, state.fixed_encoder), state.exploration

    with_actor = Learner.with_actor  # an actor reads the encoder that its critics read too

    blinded = Learner.blinded  # an actor reads the encoder, which sees all

    def copy_weights(self, own: State, parent: State) -> State:
        copied = super().copy_weights(own, parent)
        return copied._replace(encoder_opt_state=own.encoder_opt_state)

    def copy_actor(self, own: State, parent: State) -> State:
        raise UsageError(
            "copy: an actor of td7 reads its own encoder, as do its critics; allowed: full, weights"
        )
