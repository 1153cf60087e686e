"""docs/log-fields.md tells every field that a run writes, and none that no run writes."""

import re
from pathlib import Path
from typing import Any

import pytest
from short_runs import TINY, run_to_end

from pacesetter.algorithms import TABLE
from pacesetter.config import resolve
from pacesetter.runs import Row
from pacesetter.training.trainer import Trainer

PAGE = Path(__file__).parents[2] / "docs" / "log-fields.md"
MODELS: dict[str, Any] = {"model_hidden": (8,)}
STEVE: dict[str, Any] = MODELS | {"head_hidden": (8,), "models": 2, "horizon": 1}
SMALL: dict[str, Any] = {"hidden": (8,), "steps": 300, "eval_every": 150}
PARAMETER: dict[str, Any] = {"exploration": "parameter", "actor_layer_norm": True}
RUNS: dict[str, dict[str, Any]] = {
    "multi-td3": PARAMETER | {"assess": 1, "rule": "best"},
    "td3": {"members": 2, "rule": "none", "snapshots": 2},
    "sac": {"members": 2, "rule": "pbt", "select_window": 1, "vary": {"gamma": [0.9, 0.99]}},
    "tqc": {"critics": 2},
    "crossq": {"critic_hidden": (8,)},
    "sunrise": {"ensemble": 2},
    "ddpg": {},
    "td7": {"encoder_hidden": (8, 8), "encoder_size": 8},
    "sunrise-td3": {"ensemble": 2},
    "steve": STEVE,
    "steve-td3": STEVE,
    "trpo": {"parallel_envs": 2, "rollout_length": 50},
    "me-trpo": MODELS
    | {"parallel_envs": 2, "rollout_length": 125, "imagined_steps": 100, "policy_updates": 2}
    | {"horizon": 10, "starts": 5, "known": False},
}
TASK = "probe_envs:Scripted-v0"


def rows(runs: Path, algorithm: str) -> list[Row]:
    """All rows of a short run."""
    known = resolve(algorithm, TASK).settings()
    given = {name: value for name, value in TINY.items() if name in known} | SMALL
    trainer = Trainer(algorithm, TASK, runs=runs, **given, **RUNS[algorithm])
    return run_to_end(trainer).rows()


def told() -> dict[str, set[str]]:
    """The names in the first column of the tables, by the page's headings."""
    sections = re.split(r"^## ", PAGE.read_text(), flags=re.MULTILINE)[1:]
    found: dict[str, set[str]] = {}
    for section in sections:
        heading, *lines = section.splitlines()
        cells = [line.split("|")[1] for line in lines if line.startswith("| `")]
        found[heading] = {name for cell in cells for name in re.findall(r"`([\w.]+)`", cell)}
    return found


def test_every_algorithm_is_run() -> None:
    assert {name.removeprefix("multi-") for name in RUNS} == TABLE.keys()


@pytest.mark.slow
def test_page_tells_the_fields_that_runs_write(runs: Path) -> None:
    """Each under the heading of its kind."""
    page, written = told(), {"eval": set[str](), "train": set[str](), "select": set[str]()}
    for algorithm in RUNS:
        for row in rows(runs, algorithm):
            written[row["kind"]] |= row.keys()
    bins = {name for name in written["train"] if re.fullmatch(r"backup_weight_0\.\d", name)}
    written["train"] -= bins - {min(bins), max(bins)}
    for kind, names in written.items():
        assert names - page["Every row"] == page[kind], kind
    assert page["Every row"] <= set.union(*written.values())
