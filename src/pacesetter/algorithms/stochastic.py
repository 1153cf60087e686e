"""What learners with a squashed Gaussian policy share: acting, the temperature, copying."""

from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from pydantic import AfterValidator

from pacesetter.algorithms.contract import Array, Learner
from pacesetter.networks import gaussian, mlp
from pacesetter.types import Floats, Layers


def _policy(kind: str) -> str:
    if kind != "policy":
        raise ValueError("is fixed: a stochastic policy explores by itself; allowed: policy")
    return kind


Exploration = Annotated[str, AfterValidator(_policy)]


class StochasticLearner(Learner):
    """Defaults for SAC and its kin.

    Their states have `actor`, `critic`, `log_alpha`, an optimiser state of each, and `updates`.
    """

    def act(
        self, params: Layers, noise_state: Any, observation: Floats, rng: np.random.Generator
    ) -> tuple[Floats, Any]:
        return gaussian.explore(params, observation, rng), noise_state

    def fit_temperature(self, state: Any, log_prob: Array, share: Array | float = 1.0) -> Any:
        """One Adam step of the temperature; too little entropy raises it.

        `share` is the mean weight of the transitions behind the mean `log_prob`.
        """
        hyper = self.hyper
        wanted = -self.spec.action_size if hyper.target_entropy is None else hyper.target_entropy
        excess = -log_prob - share * wanted  # d/dlog_alpha of log_alpha * excess entropy
        adam = optax.adam(hyper.alpha_learning_rate)
        log_alpha, opt_state = mlp.apply_gradient(
            adam, state.log_alpha, excess, state.alpha_opt_state
        )
        return state._replace(log_alpha=log_alpha, alpha_opt_state=opt_state)

    def with_actor(self, state: Any, layers: Layers) -> Any:
        """Its mean; the standard deviation, which a policy file has not, starts anew."""
        *_, last = state.actor
        size = self.spec.action_size
        spread = {name: np.asarray(value)[..., size:] for name, value in last.items()}
        *hidden, mean = layers
        joined = {name: np.concatenate([mean[name], spread[name]], axis=-1) for name in mean}
        return state._replace(actor=mlp.replaced(state.actor, [*hidden, joined]))

    def blinded(self, state: Any, seen: Array) -> Any:
        return state._replace(actor=mlp.blinded(state.actor, seen))

    def copy_weights(self, own: Any, parent: Any) -> Any:
        return parent._replace(
            actor_opt_state=own.actor_opt_state,
            critic_opt_state=own.critic_opt_state,
            alpha_opt_state=own.alpha_opt_state,
            updates=own.updates,
        )

    def copy_actor(self, own: Any, parent: Any) -> Any:
        fresh = jax.tree.map(jnp.zeros_like, own.actor_opt_state)
        return own._replace(actor=parent.actor, actor_opt_state=fresh)
