"""Runs whose members play episodes with a length and a return that the test says."""

from pathlib import Path
from typing import Any

from short_runs import TINY

from pacesetter.training.trainer import Trainer

ENV = "probe_envs:Scripted-v0"
IDLE = {"updates_per_step": 1e-9}  # nobody learns, where only counting matters


def start(
    runs: Path,
    returns: Any = ([3], [5], [4]),
    lengths: tuple[int, ...] = (10, 10, 10),
    algorithm: str = "multi-td3",
    **settings: Any,
) -> Trainer:
    """A run whose member k plays episodes of given length and returns, marked k."""
    trainer = Trainer(algorithm, ENV, runs=runs, **{**TINY, "warmup": 0, "steps": 120, **settings})
    for k, explorer in enumerate(trainer.loop.explorers):
        script(explorer.env, returns=list(returns[k]), length=lengths[k], mark=float(k), episode=-1)
    return trainer


def script(env: Any, **attributes: Any) -> None:
    for name, value in attributes.items():
        assert hasattr(env.env.unwrapped, name)
        setattr(env.env.unwrapped, name, value)
