"""docs/log-fields.md tells every field that a run writes, and none that no run writes."""

import re
from pathlib import Path
from typing import Any

import pytest
from short_runs import TINY, run_to_end

from pacesetter.training.trainer import Trainer

PAGE = Path(__file__).parents[2] / "docs" / "log-fields.md"
MODELS: dict[str, Any] = {"model_hidden": (8,)}
SMALL: dict[str, Any] = {"hidden": (8,), "steps": 300, "eval_every": 150}
PARAMETER: dict[str, Any] = {"exploration": "parameter", "actor_layer_norm": True}
RUNS: dict[str, dict[str, Any]] = {
    "multi-td3": PARAMETER | {"assess": 1, "rule": "best"},
    "td3": {"members": 2, "rule": "none", "snapshots": 2},
    "sac": {},
    "crossq": {"critic_hidden": (8,)},
    "sunrise": {"ensemble": 2},
    "steve-td3": MODELS | {"head_hidden": (8,), "models": 2, "horizon": 1},
    "trpo": {"parallel_envs": 2, "rollout_length": 50},
    "me-trpo": MODELS
    | {"parallel_envs": 2, "rollout_length": 125, "imagined_steps": 100, "policy_updates": 2}
    | {"horizon": 10, "starts": 5, "known": False},
}
TASK = "probe_envs:Scripted-v0"


def fields(runs: Path, algorithm: str) -> set[str]:
    """The names in all rows of a short run."""
    from pacesetter.config import resolve

    known = resolve(algorithm, TASK).settings()
    given = {name: value for name, value in TINY.items() if name in known} | SMALL
    trainer = Trainer(algorithm, TASK, runs=runs, **given, **RUNS[algorithm])
    return {name for row in run_to_end(trainer).rows() for name in row}


def told() -> set[str]:
    """The names in the first column of the page's tables."""
    lines = [line for line in PAGE.read_text().splitlines() if line.startswith("| `")]
    return {name for line in lines for name in re.findall(r"`([\w.]+)`", line.split("|")[1])}


@pytest.mark.slow
def test_page_tells_the_fields_that_runs_write(runs: Path) -> None:
    written = {name for algorithm in RUNS for name in fields(runs, algorithm)}
    bins = {name for name in written if re.fullmatch(r"backup_weight_0\.\d", name)}
    assert told() == written - (bins - {min(bins), max(bins)})
