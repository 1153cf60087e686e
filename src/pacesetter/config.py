"""The settings of a run: merged from defaults, presets, files and flags, and checked once."""

import re
import tomllib
from collections.abc import Mapping
from dataclasses import asdict, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from pydantic import Field
from pydantic.dataclasses import dataclass

from pacesetter import algorithms
from pacesetter.ensemble import varied
from pacesetter.errors import UsageError, unknown
from pacesetter.settings import (
    MAX_ROWS_PER_TICK,
    STRICT,
    ModelDriven,
    OffPolicy,
    OnPolicy,
    Settings,
    budget,
)
from pacesetter.settings.ensemble import Ensemble
from pacesetter.settings.task import Task
from pacesetter.settings.validation import build, fields_of
from pacesetter.settings.values import Count, Duration

if TYPE_CHECKING:
    from pacesetter.envs import Recipe


@dataclass(frozen=True, kw_only=True, config=STRICT)
class Run(Ensemble, Task):
    """All settings of a run but those of its algorithm."""

    eval_every: Count = Field(5_000, ge=1, description="env steps between evaluations")
    eval_episodes: int = Field(10, ge=1, description="episodes per evaluation")
    keep: int = Field(
        0, ge=0, description="keep the policies of this many last evaluations in policies/"
    )
    checkpoint_every: Duration = Field(
        60.0, gt=0, description="time between checkpoints, such as 5m"
    )
    device: Literal["auto", "cpu", "gpu", "tpu"] = Field(
        "auto",
        description="device that runs the updates; auto takes JAX's own choice, a GPU before "
        "the CPU",
    )


class Config(NamedTuple):
    """All settings of a run: what to train, and the algorithm's own."""

    run: Run
    hyper: Any

    @property
    def recipe(self) -> "Recipe":
        """How the run's task is made."""
        from pacesetter.envs import Recipe

        run = self.run
        return Recipe(run.env, run.env_kwargs, run.wrap, timeout=run.env_timeout)

    @property
    def steps_per_count(self) -> int:
        """Env steps of all members for each one that `--steps` and the intervals count."""
        return budget.steps_per_count(vars(self.run))

    @property
    def budget(self) -> int:
        """Env steps that all members make together, until the run is over."""
        return budget.budget(vars(self.run))

    @property
    def select_after(self) -> int:
        """Env steps of all members before the first selection."""
        after = self.run.select_after
        return self.hyper.warmup if after is None else after

    def annealed(self, step: int) -> float:
        """How far a replay's importance exponent has gone from its start to 1, in [0, 1]."""
        horizon = (self.hyper.replay_horizon or 0) * self.steps_per_count
        return min(step / horizon, 1.0) if horizon else 1.0

    @property
    def lr_updates(self) -> float:
        """Critic updates of one member until its learning rates have fallen to `--lr-end`."""
        hyper = self.hyper
        learning = max((hyper.lr_horizon or 0) * self.steps_per_count - hyper.idle_steps, 1)
        return learning / self.run.members * hyper.updates_per_step

    def settings(self) -> Settings:
        """All settings as one flat table, which `resolve` takes back."""
        return asdict(self.run) | asdict(self.hyper)


def presets() -> dict[str, Settings]:
    """The shipped presets by name."""
    return tomllib.loads(Path(algorithms.__file__).with_name("presets.toml").read_text("utf-8"))


def preset_layers(name: str, env: str) -> tuple[str, list[Settings]]:
    """The algorithm behind a name, and its presets' settings in order; later ones win."""
    known = presets()
    if name in known:
        table = dict(known[name])
        by_env: dict[str, Settings] = table.pop("env", {})
        base, layers = preset_layers(table.pop("algorithm"), env)
        shared = {key: value for key, value in table.items() if key not in ("help", "source")}
        return base, [*layers, shared, *(t for p, t in by_env.items() if fnmatchcase(env, p))]
    several = name.startswith("multi-")
    if several and (":" in name or name[6:] in {*algorithms.names(), *known}):
        base, layers = preset_layers(name.removeprefix("multi-"), env)
        return base, [*layers, {"members": 2, "rule": "best"}]
    if name not in algorithms.names() and ":" not in name:
        every = {*algorithms.names(), *known, *algorithms.multi_names()}
        raise unknown("algorithm", name, every)
    return name, []


def merge(*layers: Mapping[str, Any]) -> Settings:
    """One table of several, of which later ones win; keywords of the task are merged one by one."""
    merged: Settings = {}
    for layer in layers:
        old, new = merged.get("env_kwargs"), layer.get("env_kwargs")
        merged |= layer
        if isinstance(old, dict) and isinstance(new, dict):
            merged["env_kwargs"] = {**old, **new}
    return merged


def resolve(name: str, env: str, *layers: Mapping[str, Any]) -> Config:
    """Merge defaults, presets and the given layers, of which later ones win; check them once.

    An id without a version is of Gymnasium's newest.
    """
    env = full_id(env)
    base, below = preset_layers(name, env)
    hyper_type = algorithms.find(base).Hyper
    merged = merge({"name": name.replace(":", "-")}, *below, *layers)
    merged |= {"algorithm": base, "env": env}
    run_names, hyper_names = fields_of(Run).keys(), fields_of(hyper_type).keys()
    for key in merged:
        if key not in run_names | hyper_names:
            help_of = f"pacesetter train {name} {env} --help"
            raise unknown("setting", key, run_names | hyper_names, help_of)
    run = build(Run, {key: value for key, value in merged.items() if key in run_names})
    hyper = build(hyper_type, {key: value for key, value in merged.items() if key in hyper_names})
    if isinstance(hyper, OffPolicy):
        _refuse_conflicts(run, hyper)
        varied.check(run, hyper)
        if hyper.exponents[1] and hyper.replay_horizon is None:
            hyper = replace(hyper, replay_horizon=run.steps)  # a later budget does not change it
        if hyper.lr_end != 1 and hyper.lr_horizon is None:
            hyper = replace(hyper, lr_horizon=run.steps)
    if isinstance(hyper, OnPolicy):
        _refuse_ensemble(run)
        _refuse_on_policy_conflicts(run, hyper)
    return Config(run, hyper)


def full_id(env: str) -> str:
    """The id, with Gymnasium's newest version if it has none."""
    if ":" in env or re.search(r"-v\d+$", env):
        return env
    from pacesetter.envs import ids

    return ids.full_id(env)


def _refuse_on_policy_conflicts(run: Run, hyper: OnPolicy) -> None:
    known = isinstance(hyper, ModelDriven) and hyper.known
    if run.randomize and known:
        raise UsageError(
            "randomize: --known takes the reward of one task, not of many; give --no-known"
        )
    if run.wrap and known:
        raise UsageError(
            "wrap: --known takes the reward of the plain task, not of a wrapped one; "
            "give --no-known"
        )
    rollout = hyper.parallel_envs * hyper.rollout_length
    if run.steps < rollout:
        raise UsageError(
            f"steps: {run.steps} is less than one rollout of {rollout} steps; give at least "
            "that, or a smaller --rollout-length or --parallel-envs"
        )


def _refuse_conflicts(run: Run, hyper: OffPolicy) -> None:
    if hyper.n_step * run.members * hyper.num_envs > MAX_ROWS_PER_TICK:
        raise UsageError(
            f"n_step: {hyper.n_step} with {run.members} members of {hyper.num_envs} envs; "
            f"their product must be at most {MAX_ROWS_PER_TICK}"
        )
    if hyper.assess and hyper.num_envs > 1:
        raise UsageError(
            f"num_envs: --assess judges a policy by whole episodes in one env, got "
            f"{hyper.num_envs} envs; use --num-envs 1 or --assess 0"
        )
    if hyper.block > 1 and (hyper.update_at == "episode" or hyper.assess):
        raise UsageError(
            f"update_every: blocks of {hyper.block} steps and updates at an episode's end "
            "(--update-at episode, --assess) would rarely coincide; choose one"
        )
    own = budget.budget(vars(run)) // run.members
    if hyper.block > own:
        raise UsageError(
            f"update_every: a run of {own} steps per member ends before the first block of "
            f"{hyper.block} and would never learn; at most {own}"
        )
    if hyper.lr_end != 1 and run.select_on == "eval" and run.count_selection_steps:
        raise UsageError(
            "lr_end: falls with updates over --steps, but --select-on eval takes a share of the "
            "steps that is not known beforehand; add --no-count-selection-steps"
        )
    if hyper.assess and hyper.warmup_updates:
        raise UsageError(
            "warmup_updates: --assess needs episodes of a policy, but the warm-up acts at random; "
            "choose one"
        )


def _refuse_ensemble(run: Run) -> None:
    for name, info in fields_of(Ensemble).items():
        value, default = getattr(run, name), info.get_default(call_default_factory=True)
        if value != default:
            raise UsageError(
                f"{name}: {run.algorithm} trains one member, on its own rollouts; "
                f"must stay {default}, got {value}"
            )
