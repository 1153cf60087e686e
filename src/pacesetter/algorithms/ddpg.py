"""DDPG: TD3 with its three tricks off, which is the fair ablation (OurDDPG.py of sfujim/TD3).

One critic, no delay, no noise on the target action; everything else is TD3's. The preset
`ddpg-original` sets what differs in Lillicrap et al. 2016; without batch normalisation.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Annotated, ClassVar

import optax
from pydantic import Field
from pydantic.dataclasses import dataclass as settings

from pacesetter.algorithms import td3
from pacesetter.algorithms.contract import Array
from pacesetter.networks import mlp
from pacesetter.settings import STRICT, only


@settings(frozen=True, kw_only=True, config=STRICT)
class Hyper(td3.Hyper):
    """TD3's settings with the tricks fixed off, and what only the original paper changes."""

    critics: Annotated[int, only(1)] = Field(1, description="fixed: one critic")
    policy_delay: Annotated[int, only(1)] = Field(
        1, description="fixed: the actor moves at every update"
    )
    target_noise: Annotated[float, only(0)] = Field(0.0, description="fixed: no target smoothing")
    action_layer: int = Field(
        0, ge=0, le=1, description="critic layer that the action enters; 0 is the first"
    )
    critic_decay: float = Field(0.0, ge=0, description="L2 decay added to the critic's gradient")
    output_bound: float | None = Field(
        None, gt=0, description="bound of initial output weights; default 1/sqrt(inputs)"
    )


@dataclass(frozen=True)
class DDPG(td3.TD3):
    """The learner of one member."""

    Hyper: ClassVar[type] = Hyper

    @cached_property
    def critic_network(self) -> Callable[[mlp.Network, Array, Array], Array]:
        return partial(mlp.outputs, action_layer=self.hyper.action_layer)

    def new_actor(self, key: Array) -> mlp.Network:
        (observation, action), hyper = self.spec, self.hyper
        norm, bound = hyper.actor_layer_norm, hyper.output_bound
        sizes = (observation, hyper.hidden, action)
        return mlp.init(key, *sizes, layer_norm=norm, output_bound=bound)

    def new_critic(self, key: Array) -> mlp.Network:
        (observation, action), hyper = self.spec, self.hyper
        new = partial(mlp.init, layer_norm=hyper.critic_layer_norm, output_bound=hyper.output_bound)
        sizes = (observation, hyper.hidden, self.head.outputs)
        return new(key, *sizes, joins=(hyper.action_layer, action))

    @cached_property
    def critic_optimizer(self) -> optax.GradientTransformation:
        return mlp.adam(self.hyper.critic_learning_rate, self.hyper.critic_decay)
