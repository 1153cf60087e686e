"""What Python users see: public names by Tab, one-line reprs, settings that an editor completes."""

import subprocess
import sys
from pathlib import Path
from typing import get_args, get_type_hints

import numpy as np
import pytest
import typed_settings
from compare import make_run
from policies import untrained
from short_runs import TINY

import pacesetter
from pacesetter.config import resolve
from pacesetter.evaluation import Evaluation
from pacesetter.settings.typed import Name, RunSettings
from pacesetter.training.trainer import Trainer

NO_JAX = """
import sys, pacesetter
assert {"Trainer", "compare", "evaluate", "load", "__version__"} <= {*dir(pacesetter)}
assert not {"jax", "numpy"} & {*sys.modules}
from pacesetter import *
assert callable(Trainer) and callable(load)
"""


def test_public_names_are_listed_before_they_are_imported() -> None:
    done = subprocess.run([sys.executable, "-c", NO_JAX], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    assert pacesetter.__version__.count(".") == 2
    assert {*pacesetter.__all__} < {*dir(pacesetter)}
    with pytest.raises(AttributeError, match="no attribute 'train'"):
        _ = pacesetter.train  # pyright: ignore


def test_reprs_are_one_line(runs: Path) -> None:
    """In a notebook a policy's repr was 28 kB of weights, a trainer's an address."""
    trainer = Trainer("td3", "Pendulum-v1", runs=runs, **{**TINY, "steps": 300})
    reports = list(trainer)
    assert repr(trainer) == (
        f"Trainer(td3 on Pendulum-v1, seed 0: 300 of 300 steps, {runs}/Pendulum-v1/td3/0)"
    )
    last = reports[-1]
    assert repr(last).startswith(f"Report({last.kind} at step 300: ")
    assert f"mean {last.values['mean']:.5g}" in repr(last)
    policy = untrained("HalfCheetah-v5", step=1_000)
    assert repr(policy).startswith("Policy(HalfCheetah-v5, ")
    assert "step 1,000, 17 -> " in repr(policy)
    assert repr(policy).endswith(" -> 6)")
    score = Evaluation([1.0] * 100, [5] * 100, 1.0, 0.5, {})
    assert repr(score) == "Evaluation(mean 1.0, std 0.5, 100 returns)"
    make_run(runs, "Ant-v5", budget=20_000, evaluations=10)
    found = pacesetter.compare(["Ant-v5/td3"], below=runs)
    assert repr(found) == "Comparison(td3 on Ant-v5: 1 run, final)"
    for each in (trainer, policy, found, *reports):
        assert "\n" not in repr(each)
        assert len(repr(each)) < 400


def test_typed_settings_are_fresh() -> None:
    """Else: python scripts/typed_settings.py."""
    assert typed_settings.FILE.read_text() == typed_settings.text()


def test_typed_settings_are_those_that_runs_take() -> None:
    typed = get_type_hints(RunSettings)
    for name in get_args(Name):
        settings = resolve(name, "HalfCheetah-v5").settings()
        assert settings.keys() - {"algorithm", "env"} <= typed.keys(), name
    taken: RunSettings = {"steps": "1M", "hidden": (64, 64), "replay": "lap", "time": None}
    settings = resolve("td3", "Ant-v5", taken).settings()
    assert settings["steps"] == 1_000_000
    assert np.shape(settings["hidden"]) == (2,)
