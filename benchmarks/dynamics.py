"""How well a dynamics ensemble predicts HalfCheetah: held-out squared error of the change of state.

Rows come from episodes of uniform actions, of actions held for five steps, and, where policy files
are given or found in champions/, of those policies with little, with much and with no noise. Whole
episodes are held out. Printed is each number's mean squared error over its own variance, so 1 is
what the mean change would give. Two models are made from the same rows: one fitted as ME-TRPO does
it, one by as many minibatches as there are rows, as STEVE does it.

    python benchmarks/dynamics.py [--policy FILE ...]
"""

import argparse
import sys
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from tabulate import tabulate

from pacesetter import policy
from pacesetter.batch import Batch, Spec
from pacesetter.config import resolve
from pacesetter.dynamics import fit as fitting
from pacesetter.dynamics.model import Dynamics, Models
from pacesetter.envs import Environment, Recipe
from pacesetter.policy import Policy
from pacesetter.seeding import Stream
from pacesetter.types import Floats

TARGET = 0.1
HELD = 5  # steps that a random action is held
NOISE = (0.0, 0.1, 0.5)  # deviations of noise on a policy's actions
STEVE: Any = resolve("steve", "HalfCheetah-v5").hyper


def episode(env: Environment, kind: int, policies: list[Policy], rng: Any) -> list[list[Any]]:
    """Rows of one episode; `kind` goes through the ways to act."""
    env.reset()
    columns: list[list[Any]] = [[] for _ in range(5)]
    ways = 2 + len(policies) * len(NOISE)
    which, noise = divmod(kind % ways - 2, len(NOISE))
    action: Floats = np.zeros(env.action_size, np.float32)
    ended = False
    while not ended:
        if kind % ways >= 2:
            drawn = policies[which].act(env.observation) + NOISE[noise] * rng.normal(
                size=action.shape
            )
            action = np.clip(drawn, -1, 1).astype(np.float32)
        elif kind % ways == 0 or len(columns[0]) % HELD == 0:
            action = rng.uniform(-1, 1, action.shape).astype(np.float32)
        before, step = env.observation, env.step(action)
        ended = step.ended
        row = (before, action, step.reward, step.observation, 1.0 - step.terminated)
        for column, value in zip(columns, row, strict=True):
            column.append(value)
    return columns


def collect(env: Environment, count: int, policies: list[Policy], seed: int) -> Batch:
    """`count` rows of whole episodes, the last one cut."""
    rng = np.random.default_rng(seed)
    columns: list[list[Any]] = [[] for _ in range(5)]
    kind = 0
    while len(columns[0]) < count:
        for column, more in zip(columns, episode(env, kind, policies, rng), strict=True):
            column += more
        kind += 1
    arrays = [np.array(column[:count], np.float32) for column in columns]
    ones = np.ones(count, np.float32)
    return Batch(*arrays, last=0 * ones, weight=ones, mask=np.zeros((count, 0), np.float32))


def by_minibatches(dynamics: Dynamics, rows: Batch, key: Any) -> Models:
    """As many steps as there are rows, each member on its share of a minibatch."""
    models = dynamics.init(key)
    count, size = len(rows.reward), STEVE.batch_size

    def step(carry: Any, key: Any) -> Any:
        models, moments = carry
        places = jax.random.randint(key, (dynamics.members, size // dynamics.members), 0, count)
        batch = fitting.take(rows, places)
        models, moments, _ = dynamics.step(dynamics.observe(models, batch), moments, batch)
        return (models, moments), None

    start = models, dynamics.init_opt_state(models)
    (models, _), _ = jax.lax.scan(step, start, jax.random.split(key, count))
    return models


def relative_error(dynamics: Dynamics, models: Models, rows: Batch) -> tuple[Floats, Floats]:
    """Squared error (O,) over the variance of the change: the mean member's, and their mean's."""
    each = [np.stack([x] * dynamics.members) for x in (rows.observation, rows.action)]
    predicted = np.asarray(jax.jit(dynamics.predict)(models, *each)[0], float)
    variance = (rows.next_observation - rows.observation).astype(float).var(axis=0)
    own = ((predicted - rows.next_observation) ** 2).mean(axis=(0, 1)) / variance
    together = ((predicted.mean(axis=0) - rows.next_observation) ** 2).mean(axis=0) / variance
    return own, together


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env", default="HalfCheetah-v5")
    parser.add_argument("--rows", type=int, default=50_000, help="rows to learn from")
    parser.add_argument("--policy", nargs="*", type=Path, default=None, help="policy files")
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args()
    folder = Path(__file__).parent.parent / "champions"
    files = sorted(folder.glob("HalfCheetah*")) if chosen.policy is None else chosen.policy
    policies = [policy.load(file) for file in files]
    env = Environment(Recipe(chosen.env), chosen.seed, Stream.REPORT)
    rows = collect(env, chosen.rows, policies, chosen.seed)
    held = collect(env, max(chosen.rows // 4, 1_000), policies, chosen.seed + 1)
    spec = Spec(env.observation_size, env.action_size)
    dynamics = Dynamics(
        spec,
        STEVE.models,
        STEVE.model_hidden,
        STEVE.head_hidden,
        learning_rate=STEVE.model_learning_rate,
    )
    key = jax.random.key(chosen.seed)
    fit = jax.jit(partial(fitting.fit, dynamics))(dynamics.init(key), rows, key)
    made = {
        f"fitted, {int(fit.epochs)} epochs": fit.models,
        "by minibatches": jax.jit(partial(by_minibatches, dynamics))(rows, key),
    }
    table: list[list[Any]] = []
    for name, models in made.items():
        own, together = relative_error(dynamics, models, held)
        passed = "yes" if own.max() <= TARGET else "no"
        table.append([name, own.mean(), own.max(), together.mean(), passed])
    print(
        f"{chosen.env}: {chosen.rows} rows, {len(held.reward)} held out, {len(policies)} policies"
    )
    heads = ["model", "error", "worst number", "of the members' mean", f"all at most {TARGET}"]
    print(tabulate(table, headers=heads, floatfmt=".4f"))
    if any(row[-1] == "no" for row in table):
        sys.exit(1)


if __name__ == "__main__":
    main()
