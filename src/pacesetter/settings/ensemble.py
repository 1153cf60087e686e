"""Settings of members that share a replay, which a learner on rollouts has not."""

from typing import Annotated, Literal

from pydantic import AfterValidator, BeforeValidator, Field, ValidationInfo
from pydantic.dataclasses import dataclass

from pacesetter.ensemble.rules import RULES
from pacesetter.errors import unknown
from pacesetter.settings import STRICT
from pacesetter.settings.values import Count, values_by_name

SELECT_EVERY = 5_000  # env steps
WINDOWS = {"rescue": 5, "pbt": 5}  # episodes behind a selection, where the default is not one
VARIABLE = (  # settings that may differ between members
    *("actor_learning_rate", "critic_learning_rate", "alpha_learning_rate"),
    *("gamma", "exploration_noise"),
)
SPREAD_RULES = ("rescue",)  # that need the spread of a member's own episodes


def _check_rule(value: str) -> str:
    if value not in RULES:
        raise unknown("rule", value, RULES)
    return value


def _check_selects_on_eval(value: int, info: ValidationInfo) -> int:
    if value != SELECT_EVERY and info.data.get("select_on") == "train":
        raise ValueError("applies to --select-on eval, not to train")
    return value


def _check_window(value: int | None, info: ValidationInfo) -> int | None:
    if value == 1 and info.data.get("rule") in SPREAD_RULES:
        raise ValueError("--rule rescue compares members by their spread; at least 2 episodes")
    return value


@dataclass(frozen=True, kw_only=True, config=STRICT)
class Ensemble:
    """How many members there are, what they share, and how the best one is selected."""

    members: int = Field(
        1, ge=1, le=1000, description="ensemble members: learners that share the replay"
    )
    rule: Annotated[str, AfterValidator(_check_rule)] = Field(
        "best", description="selection rule: who is copied to whom; see `pacesetter list rules`"
    )
    select_on: Literal["train", "eval"] = Field(
        "train", description="select by returns of training episodes, or of extra noise-free ones"
    )
    select_every: Annotated[Count, AfterValidator(_check_selects_on_eval)] = Field(
        SELECT_EVERY, ge=1, description="env steps between selections, with --select-on eval"
    )
    select_window: Annotated[int | None, AfterValidator(_check_window)] = Field(
        None,
        ge=1,
        description="episodes per member behind each selection; default 1, with rescue or pbt 5",
    )
    select_after: Count | None = Field(
        None, ge=0, description="env steps before the first selection; default --warmup"
    )
    count_selection_steps: bool = Field(
        True, description="count the steps of extra selection episodes towards --steps"
    )
    copy: Literal["full", "weights", "actor"] = Field(
        "full", description="copy networks and optimiser state, only networks, or only the actor"
    )
    same_init: bool = Field(False, description="start all members from the same weights")
    count: Literal["all", "member"] = Field(
        "all", description="count --steps and intervals over all members, or per member"
    )
    wait: bool = Field(
        True, description="let a member whose episode has ended wait until all have ended"
    )
    replay_scope: Literal["shared", "member"] = Field(
        "shared", description="one shared replay, or one per member"
    )
    vary: Annotated[dict[str, tuple[float, ...]], BeforeValidator(values_by_name)] = Field(
        default_factory=dict,
        description="settings that differ between members, such as gamma=0.98,0.99; may be "
        f"repeated; one of {', '.join(VARIABLE)}",
    )
    vary_by: Literal["grid", "draw"] = Field(
        "grid",
        description="spread members over the grid of --vary, or draw every value equally often",
    )
    eval_policy: Literal["champion", "ema"] = Field(
        "champion",
        description="what is evaluated and saved: the champion's policy, or the mean action of all "
        "members' actors averaged over time (exponential moving averages, EMA)",
    )
    mean_actions: Literal["auto", "on", "off"] = Field(
        "auto",
        description="also evaluate the mean action of all members, and that of their EMA actors "
        "(with --eval-policy ema the champion); auto: with several members; on: each member too",
    )
    ema_tau: float = Field(0.005, gt=0, le=1, description="step of the EMA actors per actor update")
    snapshots: int = Field(
        0,
        ge=0,
        le=100,
        description="also evaluate the mean action of the champions of this many evaluations",
    )

    @property
    def evaluates_means(self) -> bool:
        """Whether the mean actions of members and of their EMA actors are evaluated."""
        return self.mean_actions == "on" or (self.mean_actions == "auto" and self.members > 1)

    @property
    def keeps_ema(self) -> bool:
        """Whether members have EMA actors."""
        return self.evaluates_means or self.eval_policy == "ema"

    @property
    def window(self) -> int:
        """Episodes per member behind each selection, given or the rule's default."""
        return self.select_window or WINDOWS.get(self.rule, 1)
