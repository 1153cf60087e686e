"""What to train and how: typed settings, merged from many places, checked once."""

import re
import tomllib
from collections.abc import Mapping
from dataclasses import asdict, fields, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

from pydantic import (
    AfterValidator,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    ValidationInfo,
)
from pydantic.dataclasses import dataclass

from pacesetter import algorithms
from pacesetter.errors import UsageError, unknown
from pacesetter.rules import RULES

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


def _rule(value: str) -> str:
    if value not in RULES:
        raise unknown("rule", value, RULES)
    return value


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
        256, ge=1, description="transitions in a minibatch"
    )
    replay_size: Count = Field(1_000_000, ge=1, description="transitions kept, oldest leave first")
    replay: Literal["uniform", "prioritized", "lap", "return"] = Field(
        "uniform", description="rows are drawn alike, by TD error (PER; LAP) or by episode return"
    )
    replay_exponent: Annotated[float | None, _only_with("prioritized", "lap", "return")] = Field(
        None, ge=0, le=2, description="power of priorities, 0 is uniform; none is 0.6, for lap 0.4"
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
    updates_per_step: float = Field(1.0, gt=0, description="critic updates an own env step")
    update_at: Literal["step", "episode"] = Field(
        "step", description="as they fall due, or all at the episode's end"
    )
    update_every: Count | None = Field(
        None, ge=1, description="own steps between blocks of updates; none is 1"
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
class OnPolicy(Hyper):
    """Settings of every algorithm that learns from the rollout just made, and then drops it."""

    envs: int = Field(16, ge=1, le=1000, description="envs of a rollout, stepped in turn")
    rollout_length: Count = Field(64, ge=1, description="steps of each env in a rollout")
    normalize_observation: bool = Field(True, description="running mean and deviation, cut at 10")


@dataclass(frozen=True, kw_only=True, config=STRICT)
class ModelDriven(OnPolicy):
    """Settings of every algorithm that learns from all steps so far, after each rollout."""

    envs: int = Field(1, ge=1, le=1000, description="envs of a rollout, stepped in turn")
    rollout_length: Count = Field(3000, ge=1, description="steps of each env in a rollout")
    replay_size: Count = Field(200_000, ge=1, description="transitions kept, oldest leave first")
    starts: int = Field(20, ge=1, description="resets an update, for imagined episodes; no steps")
    known: bool = Field(True, description="reward and end are the walker's own, not learned")


@dataclass(frozen=True, kw_only=True, config=STRICT)
class Run:
    """What to train: the task, the budget, the members and how the best one is chosen."""

    algorithm: str = Field(description="the learner; see `pacesetter list algorithms`")
    env: str = Field(description="Gymnasium id with its version, or module:Id-v0")
    env_kwargs: dict[str, Any] = Field(default_factory=dict, description="given to gymnasium.make")
    name: str = Field(pattern=r"^\w[\w.-]*$", description="folder of the run below its env")
    steps: Count = Field(1_000_000, ge=1, description="env steps of all members together")
    time: Duration | None = Field(None, gt=0, description="stop after this much time, such as 2h")
    seed: int = Field(0, ge=0, le=2**32 - 1, description="every random stream follows from it")
    members: int = Field(1, ge=1, le=1000, description="learners that share the replay")
    rule: Annotated[str, AfterValidator(_rule)] = Field(
        "best", description="who starts again from whom; see `pacesetter list rules`"
    )
    select_on: Literal["train", "eval"] = Field(
        "train", description="returns of training episodes, or of extra noise-free ones (counted)"
    )
    select_every: Count = Field(5_000, ge=1, description="steps between selections on eval")
    select_window: int = Field(1, ge=1, description="episodes a member that decide a selection")
    copy: Literal["full", "weights", "actor"] = Field(
        "full", description="networks and optimiser, networks alone, or the actor alone"
    )
    same_init: bool = Field(False, description="members start from the same weights")
    count: Literal["all", "member"] = Field(
        "all", description="`--steps` and clocks count all members' steps, or the mean member's"
    )
    wait: bool = Field(True, description="a member whose episode ended waits for the others")
    replay_scope: Literal["shared", "member"] = Field(
        "shared", description="one replay or one each"
    )
    eval_every: Count = Field(5_000, ge=1, description="steps between evaluations")
    eval_episodes: int = Field(10, ge=1, description="episodes of an evaluation")
    checkpoint_every: Duration = Field(60.0, gt=0, description="time between checkpoints")
    device: Literal["auto", "cpu", "gpu", "tpu"] = Field("auto", description="where updates run")


# What only members that share a replay need.
OF_MEMBERS = ("members", "rule", "select_on", "select_every", "select_window", "copy", "same_init")
OF_ENSEMBLES = (*OF_MEMBERS, "count", "wait", "replay_scope")


class Config(NamedTuple):
    """A whole run: what to train and with which settings."""

    run: Run
    hyper: Any

    @property
    def unit(self) -> int:
        """Steps of all members that budget and clocks count as one."""
        return self.run.members if self.run.count == "member" else 1

    def settings(self) -> Settings:
        """All settings as one flat table, which `settle` takes back."""
        return asdict(self.run) | asdict(self.hyper)


def presets() -> dict[str, Settings]:
    """The shipped presets by name."""
    return tomllib.loads(Path(__file__).with_name("presets.toml").read_text())


def preset_layers(name: str, env: str) -> tuple[str, list[Settings]]:
    """The algorithm behind a name and the settings that its presets lay over the defaults."""
    known = presets()
    if name in known:
        table = dict(known[name])
        by_env: dict[str, Settings] = table.pop("env", {})
        base, layers = preset_layers(table.pop("algorithm"), env)
        shared = {key: value for key, value in table.items() if key not in ("help", "source")}
        return base, [*layers, shared, *(t for p, t in by_env.items() if fnmatchcase(env, p))]
    if name.startswith("multi-") and name[6:] in {*algorithms.names(), *known}:
        base, layers = preset_layers(name.removeprefix("multi-"), env)
        return base, [*layers, {"members": 2, "rule": "best"}]
    if name not in algorithms.names() and ":" not in name:
        multi = [f"multi-{base}" for base in algorithms.names() if not algorithms.alone(base)]
        raise unknown("algorithm", name, {*algorithms.names(), *known, *multi})
    return name, []


def read_file(path: Path) -> Settings:
    """Settings from a TOML or JSON file, such as a finished run's config.json."""
    import json

    try:
        text = path.read_text()
        table: Any = json.loads(text) if path.suffix == ".json" else tomllib.loads(text)
    except (OSError, ValueError, RecursionError) as error:
        raise UsageError(f"config: cannot read {path}: {error}") from None
    if not isinstance(table, dict):
        raise UsageError(f"config: {path} holds no table of settings")
    found: Any = table.get("settings", table)
    if not isinstance(found, dict):
        raise UsageError(f"config: settings in {path} must be a table")
    return {key.replace("-", "_"): value for key, value in found.items()}


def settle(name: str, env: str, *layers: Mapping[str, Any]) -> Config:
    """Merge defaults, presets and the given layers (later ones win) and check the result once."""
    base, below = preset_layers(name, env)
    hyper_type = algorithms.find(base).Hyper
    merged: Settings = {"name": name.replace(":", "-")}
    for layer in (*below, *layers):
        merged |= layer
    merged |= {"algorithm": base, "env": env}
    run_names, hyper_names = names_of(Run), names_of(hyper_type)
    for key in merged:
        if key not in run_names | hyper_names:
            raise unknown("setting", key, run_names | hyper_names)
    run = build(Run, {key: value for key, value in merged.items() if key in run_names})
    hyper = build(hyper_type, {key: value for key, value in merged.items() if key in hyper_names})
    if isinstance(hyper, OffPolicy):
        if hyper.n_step * run.members > ROWS_A_TICK:
            raise UsageError(
                f"n_step: {hyper.n_step} with {run.members} members; "
                f"their product must be at most {ROWS_A_TICK}"
            )
        if hyper.exponents[1] and hyper.replay_horizon is None:
            hyper = replace(hyper, replay_horizon=run.steps)  # a later budget does not change it
    if isinstance(hyper, OnPolicy):
        _refuse_ensemble(run)
    return Config(run, hyper)


def _refuse_ensemble(run: Run) -> None:
    for field in fields(Run):
        value = getattr(run, field.name)
        if field.name in OF_ENSEMBLES and value != (default := _default(field.name)):
            raise UsageError(
                f"{field.name}: {run.algorithm} trains one member, on rollouts of its own; "
                f"must stay {default}, got {value}"
            )


def _default(name: str) -> Any:
    infos: dict[str, Any] = Run.__dict__["__pydantic_fields__"]
    return infos[name].default


def names_of(kind: type) -> set[str]:
    """Field names of a settings class."""
    return {field.name for field in fields(kind)}


def build(kind: type, table: Settings) -> Any:
    """Make checked settings, or refuse them in one line that names the field."""
    try:
        return kind(**table)
    except ValidationError as error:
        first = error.errors()[0]
        field = ".".join(str(part) for part in first["loc"][:1])
        if first["type"] == "literal_error":
            options = re.findall(r"'([^']*)'", first.get("ctx", {})["expected"])
            raise unknown(field, str(first["input"]), options) from None
        message = first["msg"].removeprefix("Value error, ").replace("Input should", "should")
        raise UsageError(f"{field}: {message}, got {first['input']!r}") from None
