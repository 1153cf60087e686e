"""What learning from one env step costs in floating-point operations, as XLA counts them.

The compiled update is asked, so nothing that XLA left out is counted; no clock is read, and the
numbers are the same on any machine. Acting is not in it: next to an update it is nothing.

Run by `.venv/bin/python benchmarks/flops.py`; see --help for other tasks.
"""

import argparse
from typing import Any

import jax
import numpy as np
from tabulate import tabulate

from pacesetter import algorithms
from pacesetter.batch import Layout, Spec
from pacesetter.envs import Environment, Recipe
from pacesetter.seeding import Stream

LEARNERS: dict[str, tuple[str, dict[str, Any]]] = {
    "td3": ("td3", {}),
    "sac": ("sac", {}),
    "sunrise": ("sunrise", {}),
    "sunrise --reference official": ("sunrise", {"reference": "official"}),
    "sunrise-td3": ("sunrise-td3", {}),
    "sunrise-td3 --ensemble 2": ("sunrise-td3", {"ensemble": 2}),
}


def megaflops(name: str, spec: Spec, **settings: Any) -> float:
    """Millions of operations in one critic update of a learner, its share of the actor's included;
    an env step makes one by default.
    """
    kind = algorithms.find(name)
    hyper = kind.Hyper(**settings)
    learner = kind.build(spec, hyper)
    masks = len(learner.mask(np.random.default_rng()))
    layout, key = Layout(spec, masks), jax.random.key(0)
    rows = np.zeros((learner.updates_per_call, hyper.batch_size, layout.width), np.float32)

    def update(state: Any, rows: Any) -> Any:
        return learner.update(
            state, layout.unpack(rows)._replace(weight=np.ones(rows.shape[:-1], np.float32)), key
        )

    compiled = jax.jit(update).lower(jax.eval_shape(learner.init, key), rows).compile()
    analysis: Any = compiled.cost_analysis()
    return analysis["flops"] / 1e6 / learner.updates_per_call


def spec_of(env: str) -> Spec:
    """Sizes of a task."""
    world = Environment(Recipe(env), 0, Stream.REPORT)
    world.close()
    return Spec(world.observation_size, world.action_size)


def table(env: str) -> str:
    """All learners on a task, in MFLOP and relative to TD3 and SAC."""
    spec = spec_of(env)
    costs = {label: megaflops(name, spec, **more) for label, (name, more) in LEARNERS.items()}
    rows = [
        (label, f"{cost:.0f}", f"{cost / costs['td3']:.1f}", f"{cost / costs['sac']:.1f}")
        for label, cost in costs.items()
    ]
    headers = (env, "MFLOP a step", "of td3", "of sac")
    return tabulate(rows, headers, "github", disable_numparse=True)


def main() -> None:
    """Print one table a task."""
    parser = argparse.ArgumentParser(description="Count the operations of updates.")
    parser.add_argument("--env", nargs="+", default=["HalfCheetah-v5"])
    for env in parser.parse_args().env:
        print(table(env), end="\n\n")


if __name__ == "__main__":
    main()
