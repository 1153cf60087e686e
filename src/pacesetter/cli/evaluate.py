"""The verb `eval`."""

import json
from argparse import Namespace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pacesetter.cli.flags import Parser, parser, split_env_kwargs

if TYPE_CHECKING:
    from pacesetter.evaluation import Evaluation


def evaluate(words: list[str]) -> int:
    """Score a policy on fresh episodes."""
    from pacesetter import evaluation
    from pacesetter.policy import load

    words, env_kwargs = split_env_kwargs(words)
    found = _parser().parse(words)
    path, env = _policy_file(found)
    policy = load(path)
    task = env or policy.about.get("env")
    if task == policy.about.get("env"):
        env_kwargs = policy.about.get("env_kwargs", {}) | env_kwargs
    how: dict[str, Any] = {"noise": found.noise, "env_kwargs": env_kwargs, "random": found.random}
    result = evaluation.evaluate(policy, env, found.episodes, found.seed, **how)
    if found.json:
        about = {"env": task, "env_kwargs": env_kwargs, "seed": found.seed, "noise": found.noise}
        source = None if found.random else str(path)
        print(json.dumps({**result.table(), **about, "policy": source}))
    else:
        step = policy.about.get("step", 0)
        who = "uniform actions" if found.random else f"policy of step {step:,}"
        print(f"{task}: {_describe(result)}; {who}")
    return 0


def _parser() -> Parser:
    command = parser("eval", "Score a run's champion, or a policy file, on fresh episodes.")
    add = command.add_argument
    add("run", metavar="RUN|FILE", help="run folder, the end of its path, or policy.safetensors")
    add("--episodes", type=int, default=100, metavar="N", help="episodes to play (default 100)")
    add("--seed", type=int, default=0, metavar="N", help="seed of the start states (default 0)")
    noise = "standard deviation of Gaussian noise on actions in [-1, 1] (default 0)"
    add("--noise", type=float, default=0.0, metavar="X", help=noise)
    add("--env", metavar="ID", help="task to play (default the policy's own)")
    command.add_env_keywords()
    add("--random", action="store_true", help="play uniformly random actions instead")
    add("--json", action="store_true", help="print all returns as JSON")
    command.add_runs()
    return command


def _policy_file(found: Namespace) -> tuple[Path, str | None]:
    """The policy file that is meant, and the task if it is named or the run's."""
    from pacesetter.runs import find

    if Path(found.run).suffix == ".safetensors":
        return Path(found.run), found.env
    run = find(found.run, found.runs)
    return run.policy_file, found.env or run.settings()["env"]


def _describe(result: "Evaluation") -> str:
    count = len(result.returns)
    length = sum(result.lengths) / count
    return (
        f"return {result.mean:.1f} +- {result.std:.1f} over {count} episodes of {length:.0f} steps"
    )
