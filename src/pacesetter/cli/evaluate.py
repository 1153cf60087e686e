"""The verb `eval`."""

from typing import TYPE_CHECKING, Any

from pacesetter.cli.flags import Parser, parser
from pacesetter.cli.policies import add_run, add_seed, parse
from pacesetter.cli.streams import aside
from pacesetter.errors import UsageError
from pacesetter.storage import as_json

if TYPE_CHECKING:
    from pacesetter.evaluation import Evaluation


def evaluate(words: list[str]) -> int:
    """Score a policy on fresh episodes."""
    from pacesetter import evaluation

    given, found = parse(_parser(), words)
    if given.random and given.noise:
        raise UsageError("noise: uniformly random actions have none; leave out --noise or --random")
    policy, path, env_kwargs = found.policy, found.file, found.env_kwargs
    task = found.env or policy.about.get("env")
    how: dict[str, Any] = {"noise": given.noise, "random": given.random, **found.task}
    with aside():
        result = evaluation.evaluate(policy, episodes=given.episodes, seed=given.seed, **how)
    if given.json:
        about = {
            "env": task,
            "env_kwargs": env_kwargs,
            "wrap": list(found.wrap or ()),
            "seed": given.seed,
            "noise": given.noise,
        }
        source = None if given.random else str(path)
        print(as_json({**result.table(), **about, "policy": source}))
    else:
        step = policy.about.get("step", 0)
        who = "uniform actions" if given.random else f"policy of step {step:,}"
        print(f"{task}: {_describe(result)}; {who}")
    return 0


def _parser() -> Parser:
    command = parser("eval", "Score a run's policy, or a policy file, on fresh episodes.")
    add = command.add_argument
    add_run(command)
    add("--episodes", type=int, default=100, metavar="N", help="episodes to play (default 100)")
    add_seed(command)
    noise = "standard deviation of Gaussian noise on actions in [-1, 1] (default 0)"
    add("--noise", type=float, default=0.0, metavar="X", help=noise)
    add("--random", action="store_true", help="play uniformly random actions instead")
    add("--json", action="store_true", help="print all returns as JSON")
    return command


def _describe(result: "Evaluation") -> str:
    count = len(result.returns)
    played = f"{count:,} episode{'s' if count > 1 else ''}"
    length = sum(result.lengths) / count
    return f"return {result.mean:.1f} +- {result.std:.1f} over {played} of {length:.0f} steps"
