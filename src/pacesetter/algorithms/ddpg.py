"""DDPG: TD3 with its three tricks off, which is the fair ablation (OurDDPG.py of sfujim/TD3).

One critic, no delay, no noise on the target action; everything else is TD3's. The preset
`ddpg-original` sets what differs in Lillicrap et al. 2016; without batch normalisation.
"""

from typing import Annotated

from pydantic import Field
from pydantic.dataclasses import dataclass as settings

from pacesetter.algorithms import td3
from pacesetter.algorithms.contract import Spec
from pacesetter.settings import STRICT, only


@settings(frozen=True, kw_only=True, config=STRICT)
class Hyper(td3.Hyper):
    """TD3's settings with the tricks fixed off, and what only the original paper changes."""

    critics: Annotated[int, only(1)] = Field(1, description="fixed: one critic")
    policy_delay: Annotated[int, only(1)] = Field(
        1, description="fixed: the actor moves at every update"
    )
    target_noise: Annotated[float, only(0)] = Field(0.0, description="fixed: no target smoothing")
    action_layer: int = Field(0, ge=0, le=1, description="critic layer that the action joins")
    critic_decay: float = Field(0.0, ge=0, description="L2 added to the critic's gradient")
    output_bound: float | None = Field(None, gt=0, description="bound of initial output weights")


def build(spec: Spec, hyper: Hyper) -> td3.TD3:
    """The learner of one member."""
    return td3.TD3(spec, hyper, hyper.action_layer, hyper.critic_decay, hyper.output_bound)
