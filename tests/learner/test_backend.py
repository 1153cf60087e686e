"""What numbers depend on is the same in every process, and on record."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import pytest
from short_runs import TINY, assert_same, run_to_end

from pacesetter.errors import TrainingError
from pacesetter.learner.backend import NUMERICS, made_with, prepare
from pacesetter.training import trainer as trainers
from pacesetter.training.trainer import Trainer

PROBE = "broken_envs:Probe-v0"
OTHER: dict[str, Any] = {
    "jax_enable_x64": True,
    "jax_default_prng_impl": "rbg",
    "jax_threefry_partitionable": False,
    "jax_random_seed_offset": 7,
    "jax_default_matmul_precision": "bfloat16",
}


DEFAULTS = """
import json, sys, jax
print(json.dumps({name: jax.config.values[name] for name in sys.argv[1:]}))
"""


def test_defaults_are_those_of_jax() -> None:
    """So that holding them fast changed no run, and a JAX with others is noticed; in a process of
    its own, since this one is prepared already.
    """
    untold = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    words = [sys.executable, "-c", DEFAULTS, *NUMERICS]
    done = subprocess.run(words, env=untold, capture_output=True, text=True, check=True)
    assert json.loads(done.stdout) == NUMERICS


def test_settings_of_this_process_change_no_run(tmp_path: Path) -> None:
    """They are set back, with a note each; the record says what was in force."""
    plain = run_to_end(Trainer("td3", PROBE, runs=tmp_path / "plain", **TINY, steps=150))
    try:
        for name, value in OTHER.items():
            jax.config.update(name, value)
        trainer = Trainer("td3", PROBE, runs=tmp_path / "other", **TINY, steps=150)
    finally:
        for name, value in NUMERICS.items():
            jax.config.update(name, value)
    assert [note.split()[0] for note in trainer.notes] == [*NUMERICS]
    assert_same(plain, run_to_end(trainer))
    for run in (plain, trainer.directory):
        assert run.record()["numerics"] == NUMERICS


def test_libraries_that_are_told_otherwise_are_on_record(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NVIDIA_TF32_OVERRIDE", "0")
    trainer = Trainer("td3", PROBE, runs=tmp_path, **TINY, steps=150)
    trainer.close()
    assert trainer.directory.record()["numerics"] == NUMERICS | {"NVIDIA_TF32_OVERRIDE": "0"}


def test_a_device_is_that_of_one_run() -> None:
    """The next run, with `auto`, has JAX's own choice again; the record says where updates run."""
    try:
        prepare("cpu")
        assert jax.config.values["jax_default_device"] is not None
        assert made_with("xla")["backend"] == "cpu"
    finally:
        prepare("auto")
    assert jax.config.values["jax_default_device"] is None


@pytest.mark.parametrize("text", ["RESOURCE_EXHAUSTED: Out of memory", "INTERNAL: no link"])
def test_a_fault_of_the_device_is_one_line(
    text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At the start, which leaves no folder, and in an update."""

    def fail(*arguments: Any) -> None:
        raise jax.errors.JaxRuntimeError(text)

    full = "is out of memory, lower --members, --batch-size or the widths"
    said = f"the cpu {full if 'RES' in text else 'fails'}: {text}"
    with monkeypatch.context() as patch:
        patch.setattr(trainers, "start_from", fail)
        with pytest.raises(TrainingError, match=said):
            Trainer("td3", PROBE, runs=tmp_path / "runs", **TINY)
    assert not (tmp_path / "runs").exists()
    trainer = Trainer("td3", PROBE, runs=tmp_path / "runs", **TINY)
    monkeypatch.setattr(trainer.loop, "tick", fail)
    with pytest.raises(TrainingError, match=said):
        run_to_end(trainer)
    Trainer.resume(trainer.directory.path).close()
