"""What a run's config.json and its log may hold, checked as they are read.

The checks are of what commands look at; other keys, such as those of a later version, may be there.
"""

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, Field

from pacesetter.settings.validation import Finite, Natural, check
from pacesetter.text import check_id

SCHEMA = 1
Positive = Annotated[Natural, Field(ge=1)]
Id = Annotated[str, AfterValidator(check_id)]


class _Settings(BaseModel):
    algorithm: Id
    env: Id
    name: Annotated[str, Field(pattern=r"^\w[\w.-]*$")]
    seed: Natural
    steps: Positive
    members: Annotated[Positive, Field(le=1000)] = 1
    count: Literal["all", "member"] = "all"
    time: Finite | None = None
    eval_every: Positive
    eval_episodes: Positive = 1
    env_kwargs: dict[str, Any] = {}
    wrap: list[str] = []
    stop_at: Finite | None = None
    stop_patience: Positive | None = None
    replay_horizon: Positive | None = None
    lr_horizon: Positive | None = None
    rule: str = ""


class _Made(BaseModel):
    """What made a run, or went on with it."""

    command: str = ""
    machine: str = ""
    commit: str | None = None
    versions: dict[str, str] = {}
    products: str | None = None


class _Resumed(_Made):
    threads: Positive | None = None


class Record(_Made):
    """config.json, and the first part of a line of results."""

    schema_: Literal[1] = Field(alias="schema")
    settings: _Settings
    threads: Positive
    resumed: list[_Resumed] = []


class _Row(BaseModel):
    kind: str
    step: Natural
    cpu_seconds: Annotated[Finite, Field(ge=0)] = 0
    wall_seconds: Annotated[Finite, Field(ge=0)] = 0
    updates: Natural = 0
    transitions: Natural = 0
    episodes: Natural = 0
    selection_steps: Natural = 0
    member_steps: list[Natural] = []


class _Evaluation(_Row):
    mean: Finite | None = None
    std: Finite | None = None
    returns: Annotated[list[Finite | None], Field(min_length=1)]


class _Selection(_Row):
    gap: Finite | None = None
    standard_error: Finite | None = None
    parents: list[Natural] = []
    champion: Natural = 0


_KINDS: dict[Any, type[_Row]] = {"eval": _Evaluation, "select": _Selection}


def check_record(table: Any) -> None:
    """Refuse a config.json by a ValueError that names the field."""
    if isinstance(table, dict) and table.get("schema") not in (None, SCHEMA):
        raise ValueError(f"schema {table['schema']!r}, this version reads {SCHEMA}")
    check(Record, table)


def check_row(row: Any) -> None:
    """Refuse a row of the log by a ValueError that names the field."""
    kind = row.get("kind") if isinstance(row, dict) else None
    check(_KINDS.get(kind, _Row) if isinstance(kind, str) else _Row, row)
