"""What bias, ReLU and layer norm cost beside the products: the most that fusing them could gain.

    NPROC=1 taskset -c 0 python benchmarks/fusing.py [--precision bf16]

Two networks of four layers of 256 units, forward and backward, as an update has them. Each row adds
one thing to the row above it, so a difference is what that thing costs once it is made apart from
the product. A call that made both at once would save at most that.
"""

import argparse
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from ceiling import timed
from jax.lax import rsqrt
from tabulate import tabulate

from pacesetter.learner.precision import bfloat16_products
from pacesetter.learner.products import by_library, way

UNITS, LAYERS, NETWORKS = 256, 4, 2
BATCHES = (64, 128, 256)
REPEATS = 20
ADDED = ("products", "+ bias", "+ ReLU", "+ layer norm")


def layer(x: Any, kernel: Any, bias: Any, added: int) -> Any:
    """One layer with the first `added` things beside its product."""
    made = x @ kernel
    if added > 0:
        made = made + bias
    if added > 2:
        centered = made - made.mean(-1, keepdims=True)
        made = centered * rsqrt((centered**2).mean(-1, keepdims=True) + 1e-5)
    return jax.nn.relu(made) if added > 1 else made


def gradient(added: int, precision: str) -> Callable[[Any, Any], Any]:
    """The gradient of the networks' outputs with regard to inputs and weights."""

    def loss(x: Any, weights: Any) -> Any:
        for kernel, bias in weights:
            x = layer(x, kernel, bias, added)
        return (x**2).mean()

    found = jax.grad(loss, (0, 1))
    rounded = bfloat16_products(found) if precision == "bf16" else found
    return jax.jit(by_library(rounded, precision))


def main() -> None:
    """Print the table; the ways take turns, and the best of their repeats counts."""
    parser = argparse.ArgumentParser(description="Time what stands beside the products.")
    parser.add_argument("--precision", choices=["f32", "bf16"], default="bf16")
    parser.add_argument("--rounds", type=int, default=15)
    chosen = parser.parse_args()
    columns: list[list[float]] = []
    for batch in BATCHES:
        keys = jax.random.split(jax.random.key(0), LAYERS + 1)
        x = jax.random.normal(keys[0], (NETWORKS, batch, UNITS))
        weights = [
            (jax.random.normal(key, (NETWORKS, UNITS, UNITS)) / 16, jnp.zeros((NETWORKS, 1, UNITS)))
            for key in keys[1:]
        ]
        ways = [gradient(added, chosen.precision) for added in range(len(ADDED))]
        calls = [partial(way, x, weights) for way in ways]
        for call in calls:
            jax.block_until_ready(call())
        rounds = [[1e6 * timed(call, REPEATS) for call in calls] for _ in range(chosen.rounds)]
        columns.append([min(of_one) for of_one in zip(*rounds, strict=True)])
    rows = [
        [name, *(f"{column[i]:.0f} ({column[i] / column[0]:.2f})" for column in columns)]
        for i, name in enumerate(ADDED)
    ]
    print(f"us per gradient, products by {way(chosen.precision)} in {chosen.precision}")
    print(tabulate(rows, ["", *(f"batch {batch}" for batch in BATCHES)], tablefmt="github"))


if __name__ == "__main__":
    main()
