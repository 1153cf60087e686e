"""Settings that several learners share."""

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, ConfigDict, Field, ValidationInfo
from pydantic.dataclasses import dataclass

from pacesetter.settings.values import (
    Count,
    Indices,
    LearningRate,
    SmallCount,
    Switch,
    Tau,
    Tune,
    Warmup,
    Width,
)

Settings = dict[str, Any]
STRICT = ConfigDict(extra="forbid", allow_inf_nan=False)


def only(value: float) -> AfterValidator:
    """Refuse every value but the one that an algorithm fixes."""

    def check(given: float) -> float:
        if given != value:
            raise ValueError(f"is fixed for this algorithm; allowed: {value}")
        return given

    return AfterValidator(check)


def _only_with(*kinds: str) -> AfterValidator:
    """Refuse a setting that the chosen kind of replay does not use."""

    def check(value: object, info: ValidationInfo) -> object:
        kind = info.data.get("replay", kinds[0])
        if value not in (None, False) and kind not in kinds:
            raise ValueError(f"applies to --replay {' and '.join(kinds)}, not to {kind}")
        return value

    return AfterValidator(check)


def _check_weights(value: object, info: ValidationInfo) -> object:
    kind, given = info.data.get("replay"), info.data.get("replay_importance")
    if value is not None and not (given or (given is None and REPLAYS.get(kind or "", (0, 1))[1])):
        raise ValueError("needs importance weights, which are off; set --replay-importance")
    return value


def check_loss(outputs: int, info: ValidationInfo) -> int:
    """Refuse quantiles or bins with a replay that sets the loss."""
    if outputs and info.data.get("replay") == "lap":
        raise ValueError(
            "cannot be combined with --replay lap, as each sets the loss; allowed with it: 0"
        )
    return outputs


def _check_assess(value: int | None, info: ValidationInfo) -> int | None:
    if value is not None and not info.data.get("assess"):
        raise ValueError("needs --assess, which is off")
    return value


def _check_horizon(value: int | None, info: ValidationInfo) -> int | None:
    if value is not None and info.data.get("lr_end") == 1:
        raise ValueError("needs --lr-end below 1, as rates are constant otherwise")
    return value


MAX_ROWS_PER_TICK = 1_000  # transitions that a replay takes at a time, of all members together
NORMALIZE = "normalize observations by running mean and standard deviation, clip at 10"
REPLAY_SIZE = "transitions kept; the oldest are overwritten first"
# Default exponents of each kind of replay: of priorities, and of importance weights.
REPLAYS = {
    "uniform": (0.0, 0.0),
    "prioritized": (0.6, 0.4),
    "lap": (0.4, 0.0),
    "return": (0.6, 0.0),
}


@dataclass(frozen=True, kw_only=True, config=STRICT)
class Hyper:
    """Settings of every algorithm; each algorithm's own `Hyper` adds to them."""

    gamma: Annotated[float, Tune(0.97, 0.999)] = Field(
        0.99, ge=0, le=1, description="discount factor per env step"
    )
    normalize_observation: Switch = Field(False, description=NORMALIZE)


@dataclass(frozen=True, kw_only=True, config=STRICT)
class OffPolicy(Hyper):
    """Settings of every off-policy algorithm, which learns from a replay."""

    batch_size: Annotated[SmallCount, Tune(64, 512, log=True)] = Field(
        256, description="transitions per minibatch"
    )
    replay_size: Count = Field(1_000_000, ge=1, description=REPLAY_SIZE)
    replay: Literal["uniform", "prioritized", "lap", "return"] = Field(
        "uniform",
        description="sample transitions uniformly, by TD error (PER or LAP) or by episode return",
    )
    replay_exponent: Annotated[float | None, _only_with("prioritized", "lap", "return")] = Field(
        None,
        ge=0,
        le=2,
        description="priority exponent alpha; 0 samples uniformly; default 0.6, or 0.4 for lap",
    )
    replay_importance: Annotated[float | None, _only_with("prioritized", "return")] = Field(
        None,
        ge=0,
        le=1,
        description="initial importance exponent beta, annealed to 1; 0 disables weights; "
        "default 0.4, or 0 for return",
    )
    replay_horizon: Annotated[
        Count | None, _only_with("prioritized", "return"), AfterValidator(_check_weights)
    ] = Field(None, ge=1, description="env steps until beta is 1; default --steps")
    replay_to_go: Annotated[bool, _only_with("return")] = Field(
        False, description="rank transitions by return to go instead of the whole episode's return"
    )
    n_step: int = Field(1, ge=1, le=100, description="rewards summed in an n-step target")
    assess: int = Field(
        0,
        ge=0,
        description="training episodes that a policy plays unchanged before it may become the"
        " one that is evaluated, 20 in TD7; 0 disables it",
    )
    assess_after: Annotated[Count | None, AfterValidator(_check_assess)] = Field(
        None,
        ge=0,
        description="updates of a member before assessments take several episodes; default 750000",
    )
    warmup: Warmup = Field(
        25_000, ge=0, description="env steps of uniformly random actions at the start, all members"
    )
    warmup_updates: bool = Field(False, description="also update during the warm-up")
    updates_per_step: float = Field(
        1.0, gt=0, le=1_000, description="critic updates per env step of the member"
    )
    num_envs: int = Field(1, ge=1, le=1_000, description="envs per member, stepped in turn")
    update_at: Literal["step", "episode"] = Field(
        "step", description="update after each step, or make all due updates when the episode ends"
    )
    update_every: Count | None = Field(
        None, ge=1, description="env steps of a member between blocks of updates; default 1"
    )
    lr_end: float = Field(
        1.0,
        ge=0,
        le=1,
        description="share of every learning rate that is left at the end; it falls linearly",
    )
    lr_horizon: Annotated[Count | None, AfterValidator(_check_horizon)] = Field(
        None, ge=1, description="env steps until that share is reached; default --steps"
    )
    actor_observes: Indices | None = Field(
        None,
        description="numbers of the flat observation that the actor sees, such as 0:17 or 0:8,12; "
        "critics see all; default all",
    )
    normalize_reward: Switch = Field(
        False,
        description="divide rewards by the running standard deviation of discounted returns",
    )
    precision: Literal["f32", "bf16"] = Field(
        "f32", description="precision of large matrix products; accumulation is always float32"
    )

    @property
    def scales_rewards(self) -> bool:
        """Whether a batch's rewards are over the standard deviation of discounted returns."""
        return self.normalize_reward

    @property
    def idle_steps(self) -> int:
        """Env steps at the start that call for no update."""
        return 0 if self.warmup_updates else self.warmup

    @property
    def block(self) -> int:
        """Env steps of a member after which its due updates are made."""
        return self.update_every or 1

    @property
    def exponents(self) -> tuple[float, float]:
        """Exponents of priorities and of importance weights, given or the replay's default."""
        exponent, importance = REPLAYS[self.replay]
        if self.replay_exponent is not None:
            exponent = self.replay_exponent
        if self.replay_importance is not None:
            importance = self.replay_importance
        return exponent, importance


@dataclass(frozen=True, kw_only=True, config=STRICT)
class ActorCritic(OffPolicy):
    """Settings of every off-policy learner with an actor, several critics and target networks."""

    hidden: tuple[Width, ...] = Field(
        (256, 256), min_length=1, description="widths of the hidden layers"
    )
    actor_learning_rate: LearningRate = Field(
        3e-4, gt=0, description="Adam learning rate of the actor"
    )
    critic_learning_rate: LearningRate = Field(
        3e-4, gt=0, description="Adam learning rate of the critics"
    )
    tau: Tau = Field(0.005, gt=0, le=1, description="step size of the soft target update")
    critics: int = Field(2, ge=1, le=100, description="critics; the target uses their minimum")
    critic_layer_norm: Switch = Field(
        False, description="use layer norm before each ReLU of the critics"
    )
    actor_layer_norm: Switch = Field(
        False, description="use layer norm before each ReLU of the actor"
    )
    quantiles: Annotated[int, AfterValidator(check_loss)] = Field(
        0,
        ge=0,
        le=1_000,
        description="quantiles that each critic learns, usually 25; 0 learns only the mean",
    )


@dataclass(frozen=True, kw_only=True, config=STRICT)
class OnPolicy(Hyper):
    """Settings of every on-policy algorithm, which learns from its last rollout alone."""

    parallel_envs: int = Field(16, ge=1, le=1000, description="envs per rollout, stepped in turn")
    rollout_length: Count = Field(64, ge=1, description="steps of each env per rollout")
    normalize_observation: bool = Field(True, description=NORMALIZE)


@dataclass(frozen=True, kw_only=True, config=STRICT)
class ModelDriven(OnPolicy):
    """Settings of every model-based algorithm that learns from all transitions after a rollout."""

    parallel_envs: int = Field(1, ge=1, le=1000, description="envs per rollout, stepped in turn")
    rollout_length: Count = Field(3000, ge=1, description="steps of each env per rollout")
    replay_size: Count = Field(200_000, ge=1, description=REPLAY_SIZE)
    starts: int = Field(
        20,
        ge=1,
        description="resets per update that start imagined episodes; not counted as env steps",
    )
    known: bool = Field(
        True, description="use the walker's known reward and termination instead of learning them"
    )
