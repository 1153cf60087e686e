"""How much of an update is its own matrix products: the share of the machine's ceiling it reaches.

The products are read out of the update itself, so they are exactly its own. Each shape is timed
alone, many independent ones a call, in whichever order of its two sides is quicker, as XLA is free
to swap them; and alternates in this process with whole updates, so that what else the machine does
hits both. `--members` updates run at the same time, as in training.

    taskset -c 0 env NPROC=1 python benchmarks/ceiling.py     one core
    python benchmarks/ceiling.py --members 2                   both
"""

import argparse
import os
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from statistics import median
from time import perf_counter
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pacesetter import algorithms
from pacesetter.batch import Layout, Spec
from pacesetter.config import resolve
from pacesetter.learner.compiled import CompiledLearner, UpdateInputs

SPECS = {"HalfCheetah-v5": Spec(17, 6), "Ant-v5": Spec(105, 8), "Humanoid-v5": Spec(348, 17)}
TARGETS = {("td3", 1, 1): 0.82, ("td3", 2, 1): 0.7, ("td3", 2, 2): 0.75}  # cores, members
TOGETHER = 4  # independent products a timed call, few enough to stay in the cache
Product = tuple[tuple[int, ...], tuple[int, ...], Any]  # both shapes, dimension numbers


def products(jaxpr: Any, times: int = 1) -> Iterator[tuple[Product, int]]:
    """Every matrix product of a traced function, loops counted as often as they run."""
    for equation in jaxpr.eqns:
        if equation.primitive.name == "dot_general":
            left, right = (variable.aval.shape for variable in equation.invars)
            yield (left, right, equation.params["dimension_numbers"]), times
        inner = times * equation.params.get("length", 1)
        for parameter in equation.params.values():
            if hasattr(parameter, "jaxpr"):
                yield from products(parameter.jaxpr, inner)


def flops(product: Product) -> int:
    """Multiplications and additions of one product."""
    left, right, ((_, contracted), (_, batch)) = product
    new = [size for i, size in enumerate(right) if i not in (*contracted, *batch)]
    return 2 * int(np.prod(left) * np.prod(new))


def timed(call: Callable[[], Any], repeats: int) -> float:
    """Seconds of one call."""
    began = perf_counter()
    for _ in range(repeats):
        result = call()
    jax.block_until_ready(result)
    return (perf_counter() - began) / repeats


def swapped(product: Product) -> Product:
    """The same product with its sides exchanged, which gives the result transposed."""
    left, right, (contracted, batch) = product
    return right, left, (contracted[::-1], batch[::-1])


def quicker(product: Product, rng: np.random.Generator) -> Callable[[], Any]:
    """The product alone, in the order of its sides that takes less time."""
    calls = [alone(each, rng) for each in (product, swapped(product))]
    for call in calls:
        timed(call, 3)
    return min(calls, key=lambda call: timed(call, 20))


def alone(product: Product, rng: np.random.Generator) -> Callable[[], Any]:
    """Calls many independent products of one shape."""
    left, right, dimensions = product
    pairs = [
        tuple(jnp.asarray(rng.normal(size=shape), jnp.float32) for shape in (left, right))
        for _ in range(TOGETHER)
    ]
    program = jax.jit(lambda pairs: [jax.lax.dot_general(a, b, dimensions) for a, b in pairs])
    return lambda: program(pairs)


def whole(
    name: str, spec: Spec, members: int, env: str = "HalfCheetah-v5", **settings: Any
) -> tuple[Callable[[], Any], Counter[Product], int]:
    """A cycle of every member as training calls it, its products, and its updates."""
    config = resolve(name, env, settings)
    algorithm = algorithms.find(config.run.algorithm).build(spec, config.hyper)
    layout = Layout(spec, len(algorithm.mask(np.random.default_rng(0))))
    hyper = config.hyper
    compiled = CompiledLearner(algorithm, layout, 0, hyper.normalize_observation, hyper.precision)
    states = compiled.init(members, same=False)
    size = (algorithm.updates_per_call, config.hyper.batch_size, layout.width)
    rows = np.random.default_rng(0).normal(size=size).astype(np.float32)
    still = np.zeros(spec.observation_size, np.float32), np.ones(spec.observation_size, np.float32)
    batch = layout.unpack(jnp.asarray(rows))._replace(weight=jnp.ones(rows.shape[:-1]))
    traced = jax.make_jaxpr(algorithm.update)(states[0], batch, jax.random.key(0))
    counts: Counter[Product] = Counter()
    for product, times in products(traced.jaxpr):
        counts[product] += times * members

    workers = ThreadPoolExecutor(members)
    run = map if members == 1 else workers.map

    def one(state: Any, member: int) -> Any:
        return compiled.update(state, member, UpdateInputs(0, rows, None, still)).state

    def call() -> Any:
        states[:] = run(one, states, range(members))
        return states

    return call, counts, algorithm.updates_per_call * members


def main() -> None:
    """Alternate updates and products; print both rates and their share."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--algorithm", default="td3")
    parser.add_argument("--env", choices=SPECS, default="HalfCheetah-v5")
    parser.add_argument("--members", type=int, default=1)
    parser.add_argument("--rounds", type=int, default=15)
    chosen = parser.parse_args()
    cycle, counts, updates = whole(chosen.algorithm, SPECS[chosen.env], chosen.members, chosen.env)
    rng = np.random.default_rng(0)
    calls = {product: quicker(product, rng) for product in counts}
    timed(cycle, 3)
    found: list[tuple[float, float]] = []
    for _ in range(chosen.rounds):
        took = timed(cycle, 20) / updates
        floor = sum(timed(calls[p], 20) / TOGETHER * n for p, n in counts.items()) / updates
        found.append((took, floor))
    took, floor = (median(column) for column in zip(*found, strict=True))
    work = sum(flops(p) * n for p, n in counts.items()) / updates
    cores = len(os.sched_getaffinity(0))
    target = TARGETS.get((chosen.algorithm, cores, chosen.members))
    aim = "" if target is None else f" (target {target})"
    print(
        f"{chosen.algorithm} {chosen.env}, {chosen.members} members, {cores} cores, "
        f"jax {jax.__version__}: {work / 1e6:.0f} MFLOP an update; {1 / took:.0f} updates/s; "
        f"its products alone {1 / floor:.0f}/s ({work / floor / 1e9:.0f} GFLOP/s); "
        f"share of the ceiling = {median(f / t for t, f in found):.3f}{aim}"
    )


if __name__ == "__main__":
    main()
