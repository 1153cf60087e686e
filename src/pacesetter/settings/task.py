"""Settings of the task: what to train, where, for how long, and how the env is made."""

import json
from typing import Annotated, Any

from pydantic import AfterValidator, BeforeValidator, Field
from pydantic.dataclasses import dataclass

from pacesetter.settings import STRICT
from pacesetter.settings.values import Count, Duration, values_by_name
from pacesetter.text import check_id

TWO_VALUES = "needs its lowest and its highest value"


def _constant(word: str) -> float:
    if word == "NaN":
        raise ValueError("nan equals nothing, so no run could be told to have it")
    return float(word)


def _check_json(value: dict[str, Any]) -> dict[str, Any]:
    try:
        json.loads(json.dumps(value), parse_constant=_constant)
    except (TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"must be plain numbers, words, lists and tables: {error}") from None
    return value


def _pairs(value: object) -> Any:
    table = values_by_name(value)
    for name, numbers in table.items():
        if not isinstance(numbers, (list, tuple)) or len(list(numbers)) != 2:
            raise ValueError(f"{name} {TWO_VALUES}, as {name}=0.8,1.2")
    return table


def _ordered(value: dict[str, tuple[float, float]]) -> dict[str, tuple[float, float]]:
    for name, (low, high) in value.items():
        if low > high:
            raise ValueError(f"{name} {TWO_VALUES}, in this order")
    return value


@dataclass(frozen=True, kw_only=True, config=STRICT)
class Task:
    """What to train, where, and for how long."""

    algorithm: Annotated[str, AfterValidator(check_id)] = Field(
        description="algorithm; see `pacesetter list algorithms`"
    )
    env: Annotated[str, AfterValidator(check_id)] = Field(
        description="Gymnasium id with its version, or module:Id-v0"
    )
    env_kwargs: Annotated[dict[str, Any], AfterValidator(_check_json)] = Field(
        default_factory=dict, description="keywords for gymnasium.make"
    )
    name: str = Field(pattern=r"^\w[\w.-]*$", description="name of the run's folder, below its env")
    steps: Count = Field(
        1_000_000,
        ge=1,
        description="budget of env steps, of all members together unless --count member",
    )
    time: Duration | None = Field(
        None, gt=0, description="stop after this wall time, such as 2h; default no limit"
    )
    stop_at: float | None = Field(
        None, description="stop when an evaluation reaches this mean return; default never"
    )
    stop_patience: int | None = Field(
        None,
        ge=1,
        description="stop after so many evaluations in a row, from the first update on, without "
        "a new best mean return; default never",
    )
    start_from: str | None = Field(
        None,
        min_length=1,
        description="start all members with the networks of this earlier run, policy file or "
        "champion:NAME",
    )
    seed: int = Field(0, ge=0, le=2**32 - 1, description="seed of every random stream")
    env_timeout: Duration | None = Field(
        None,
        gt=0,
        description="end a run whose task takes longer for any call, such as 30s; default no limit",
    )
    wrap: tuple[str, ...] = Field(
        (), description="put wrappers around the task, the innermost first; may be repeated"
    )
    renew_env: bool | None = Field(
        None,
        description="make the task anew at each episode, so that none depends on those before it; "
        "default only if a test at the start finds that they do",
    )
    randomize: Annotated[
        dict[str, tuple[float, float]], BeforeValidator(_pairs), AfterValidator(_ordered)
    ] = Field(
        default_factory=dict,
        description="draw a keyword of the task anew for each training episode, such as "
        "mass=0.8,1.2; may be repeated; evaluations keep that of --env.KEY",
    )
