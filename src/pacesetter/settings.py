"""The settings that learners declare: kinds of values, the ranges `tune` searches, shared ones."""

import re
from typing import Annotated, Any, Literal, NamedTuple

from pydantic import AfterValidator, BeforeValidator, ConfigDict, Field, ValidationInfo
from pydantic.dataclasses import dataclass

Settings = dict[str, Any]
STRICT = ConfigDict(extra="forbid", allow_inf_nan=False)
_MULTIPLES = {"": 1, "k": 1_000, "m": 1_000_000}
_SECONDS = {"": 1, "s": 1, "m": 60, "h": 3600, "d": 86400}


def _count(value: object) -> object:
    found = re.fullmatch(r"(\d+(?:\.\d+)?(?:e\d+)?)([km]?)", str(value).strip().lower())
    if found is None:
        raise ValueError("is not a count; write 5000, 300k, 1M or 1e6")
    number = float(found[1]) * _MULTIPLES[found[2]]
    if number > 1e15:
        raise ValueError("is too large")
    if number != int(number):
        raise ValueError("is not a whole number")
    return int(number)


def _duration(value: object) -> object:
    found = re.fullmatch(r"(\d+(?:\.\d+)?)([smhd]?)", str(value).strip().lower())
    if value is not None and found is None:
        raise ValueError("is not a length of time; write 90s, 5m or 2h")
    return value if found is None else float(found[1]) * _SECONDS[found[2]]


def only(value: float) -> AfterValidator:
    """A setting that this algorithm fixes."""

    def check(given: float) -> float:
        if given != value:
            raise ValueError(f"is fixed for this algorithm; allowed: {value}")
        return given

    return AfterValidator(check)


def _only_with(*kinds: str) -> AfterValidator:
    """A setting that only some kinds of replay use."""

    def check(value: object, info: ValidationInfo) -> object:
        kind = info.data.get("replay", kinds[0])
        if value not in (None, False) and kind not in kinds:
            raise ValueError(f"is a setting of --replay {' and '.join(kinds)}, not of {kind}")
        return value

    return AfterValidator(check)


def _has_weights(value: object, info: ValidationInfo) -> object:
    kind, given = info.data.get("replay"), info.data.get("replay_importance")
    if value is not None and not (given or (given is None and REPLAYS.get(kind or "", (0, 1))[1])):
        raise ValueError("is of importance weights, of which there are none; --replay-importance")
    return value


def _have_one_loss(quantiles: int, info: ValidationInfo) -> int:
    if quantiles and info.data.get("replay") == "lap":
        raise ValueError("have a loss of their own, as has --replay lap; allowed with it: 0")
    return quantiles


def _assessed(value: int | None, info: ValidationInfo) -> int | None:
    if value is not None and not info.data.get("assess"):
        raise ValueError("is a setting of --assess, which is off")
    return value


ROWS_A_TICK = 1_000  # that a replay takes, of all members together
# The exponents of priorities and of importance weights that each kind of replay has by itself.
REPLAYS = {
    "uniform": (0.0, 0.0),
    "prioritized": (0.6, 0.4),
    "lap": (0.4, 0.0),
    "return": (0.6, 0.0),
}


class Tune(NamedTuple):
    """Range in which `tune` searches the setting that is annotated with it; or False and True."""

    low: float
    high: float
    log: bool = False

    def has(self, value: Any) -> bool:
        """Whether a value lies in it."""
        return self.low <= value <= self.high


Width = Annotated[int, Field(ge=1, le=16_384)]
Count = Annotated[int, BeforeValidator(_count)]
Duration = Annotated[float, BeforeValidator(_duration)]
LearningRate = Annotated[float, Tune(1e-4, 3e-3, log=True)]
Tau = Annotated[float, Tune(1e-3, 0.02, log=True)]
Warmup = Annotated[Count, Tune(1_000, 25_000, log=True)]
Switch = Annotated[bool, Tune(False, True)]


@dataclass(frozen=True, kw_only=True, config=STRICT)
class Hyper:
    """Settings that every algorithm has; each algorithm's own `Hyper` adds to them."""

    gamma: Annotated[float, Tune(0.97, 0.999)] = Field(
        0.99, ge=0, le=1, description="discount a step"
    )
    normalize_observation: Switch = Field(
        False, description="running mean and deviation, cut at 10"
    )


@dataclass(frozen=True, kw_only=True, config=STRICT)
class OffPolicy(Hyper):
    """Settings of every algorithm that learns from a replay."""

    batch_size: Annotated[int, Tune(64, 512, log=True)] = Field(
        256, ge=1, le=1_000_000, description="transitions in a minibatch"
    )
    replay_size: Count = Field(1_000_000, ge=1, description="transitions kept, oldest leave first")
    replay: Literal["uniform", "prioritized", "lap", "return"] = Field(
        "uniform", description="rows are drawn alike, by TD error (PER; LAP) or by episode return"
    )
    replay_exponent: Annotated[float | None, _only_with("prioritized", "lap", "return")] = Field(
        None,
        ge=0,
        le=2,
        description="power of priorities, 0 draws uniformly; none is 0.6, for lap 0.4",
    )
    replay_importance: Annotated[float | None, _only_with("prioritized", "return")] = Field(
        None,
        ge=0,
        le=1,
        description="power of importance weights at first, later 1; 0 is no weights; "
        "none is 0.4, for return 0",
    )
    replay_horizon: Annotated[
        Count | None, _only_with("prioritized", "return"), AfterValidator(_has_weights)
    ] = Field(None, ge=1, description="steps until that power is 1; none is --steps at the start")
    replay_to_go: Annotated[bool, _only_with("return")] = Field(
        False, description="rank rows by what the episode still paid, not by all of it"
    )
    n_step: int = Field(1, ge=1, le=100, description="rewards summed before the target's value")
    assess: int = Field(
        0, ge=0, description="episodes that assess a policy before it learns on (TD7: 20); 0 is off"
    )
    assess_after: Annotated[Count | None, AfterValidator(_assessed)] = Field(
        None, ge=0, description="a member's updates before which one assesses; none is 750000"
    )
    warmup: Warmup = Field(25_000, ge=0, description="first steps of all members, uniform actions")
    warmup_updates: bool = Field(False, description="update during the warm-up too")
    updates_per_step: float = Field(
        1.0, gt=0, le=1_000, description="critic updates an own env step"
    )
    update_at: Literal["step", "episode"] = Field(
        "step", description="as they fall due, or all at the episode's end"
    )
    update_every: Count | None = Field(
        None, ge=1, description="own steps between blocks of updates; none is 1"
    )
    precision: Literal["f32", "bf16"] = Field(
        "f32", description="of what large matrix products multiply; sums are float32 in both"
    )

    @property
    def block(self) -> int:
        """Own env steps after which the updates that have fallen due are made."""
        return self.update_every or 1

    @property
    def exponents(self) -> tuple[float, float]:
        """Of priorities and of importance weights, given or the replay's own."""
        exponent, importance = REPLAYS[self.replay]
        if self.replay_exponent is not None:
            exponent = self.replay_exponent
        if self.replay_importance is not None:
            importance = self.replay_importance
        return exponent, importance


@dataclass(frozen=True, kw_only=True, config=STRICT)
class ActorCritic(OffPolicy):
    """Settings of every learner with an actor, several critics and their slowly moving targets."""

    hidden: tuple[Width, ...] = Field(
        (256, 256), min_length=1, description="widths of hidden layers"
    )
    actor_learning_rate: LearningRate = Field(3e-4, gt=0, description="Adam step size of the actor")
    critic_learning_rate: LearningRate = Field(
        3e-4, gt=0, description="Adam step size of the critics"
    )
    tau: Tau = Field(0.005, gt=0, le=1, description="share of the network in a target update")
    critics: int = Field(2, ge=1, le=100, description="critics whose minimum is the target")
    critic_layer_norm: Switch = Field(False, description="layer norm before each critic ReLU")
    actor_layer_norm: Switch = Field(False, description="layer norm before each actor ReLU")
    quantiles: Annotated[int, AfterValidator(_have_one_loss)] = Field(
        0,
        ge=0,
        le=1_000,
        description="quantiles that a critic learns, usually 25; 0 learns the mean alone",
    )


@dataclass(frozen=True, kw_only=True, config=STRICT)
class OnPolicy(Hyper):
    """Settings of every algorithm that learns from the rollout just made, and then drops it."""

    parallel_envs: int = Field(16, ge=1, le=1000, description="envs of a rollout, stepped in turn")
    rollout_length: Count = Field(64, ge=1, description="steps of each env in a rollout")
    normalize_observation: bool = Field(True, description="running mean and deviation, cut at 10")


@dataclass(frozen=True, kw_only=True, config=STRICT)
class ModelDriven(OnPolicy):
    """Settings of every algorithm that learns from all steps so far, after each rollout."""

    parallel_envs: int = Field(1, ge=1, le=1000, description="envs of a rollout, stepped in turn")
    rollout_length: Count = Field(3000, ge=1, description="steps of each env in a rollout")
    replay_size: Count = Field(200_000, ge=1, description="transitions kept, oldest leave first")
    starts: int = Field(20, ge=1, description="resets an update, for imagined episodes; no steps")
    known: bool = Field(True, description="reward and end are the walker's own, not learned")
