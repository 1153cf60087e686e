"""STEVE over TD3: targets from the minimum of twins and a smoothed target action at every horizon.

Not in the paper, but what a fair test against TD3 needs: with horizon 0 and one member it is TD3.
The actor climbs the mean of the first twins.
"""

from dataclasses import dataclass
from typing import Annotated, ClassVar

from pydantic import AfterValidator, Field
from pydantic.dataclasses import dataclass as settings

from pacesetter.algorithms import steve, td3
from pacesetter.settings import STRICT


@settings(frozen=True, kw_only=True, config=STRICT)
class Hyper(steve.ExpansionHyper, td3.Hyper):
    """TD3's settings and the expansion's."""

    critic_members: Annotated[int, AfterValidator(steve.can_disagree)] = Field(
        2,
        ge=1,
        validate_default=True,
        description="pairs of critics whose disagreement weights the target",
    )


@dataclass(frozen=True)
class SteveTD3(steve.Expansion):
    """The learner of one member, over TD3."""

    Hyper: ClassVar[type] = Hyper
