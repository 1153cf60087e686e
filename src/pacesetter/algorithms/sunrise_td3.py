"""SUNRISE over TD3, which is in no paper: what compares with Multi-TD3 like with like.

Everything of the ensemble is as in `sunrise`; its learners are TD3's, with their smoothed target
actions, their Gaussian noise on proposals and an actor update every `policy_delay` critic updates.
"""

from functools import partial
from typing import Literal

import jax.numpy as jnp
from pydantic import Field
from pydantic.dataclasses import dataclass as settings

from pacesetter.algorithms import sunrise, td3
from pacesetter.algorithms.contract import Array, Batch, Spec
from pacesetter.settings import STRICT


@settings(frozen=True, kw_only=True, config=STRICT)
class Hyper(sunrise.Ensemble, td3.Hyper):
    """TD3's settings and the ensemble's."""

    exploration: Literal["gaussian"] = Field("gaussian", description="noise on proposed actions")


def build(spec: Spec, hyper: Hyper) -> sunrise.Sunrise:
    """The learner of one member."""
    learner = td3.TD3(spec, hyper)
    base = sunrise.Base(learner, partial(_next_action, learner), partial(_fit_actor, learner))
    return sunrise.assemble(spec, hyper, base)


def _next_action(
    learner: td3.TD3, state: td3.State, observation: Array, key: Array
) -> tuple[Array, Array]:
    return learner.next_action(state, observation, key), jnp.zeros(len(observation))


def _fit_actor(
    learner: td3.TD3, state: td3.State, batch: Batch, key: Array, weight: Array
) -> tuple[td3.State, dict[str, Array]]:
    state, loss = learner.fit_actor(state, batch, weight)
    return state, {"actor_loss": loss}
