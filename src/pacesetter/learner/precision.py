"""Matrix products of any function in bfloat16, with sums, parameters and all else in float32.

Learners know nothing of it: the finished program, gradients included, is rewritten.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, ParamSpec, TypeVar

import jax
import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal
from jax.extend.core.primitives import custom_jvp_call_p, custom_vjp_call_p, dot_general_p

P = ParamSpec("P")
R = TypeVar("R")
WITH_RULES = (custom_jvp_call_p, custom_vjp_call_p)
SMALL = 64  # products with a side below it gain nothing, as those of a few observed numbers


def bfloat16_products(function: Callable[P, R]) -> Callable[P, R]:
    """`function` whose float32 products round their operands to bfloat16 first."""

    def rewritten(*arguments: P.args, **named: P.kwargs) -> R:
        program, shape = jax.make_jaxpr(function, return_shape=True)(*arguments, **named)
        results = _run(program.jaxpr, program.consts, jax.tree.leaves((arguments, named)))
        return jax.tree.unflatten(jax.tree.structure(shape), results)

    return rewritten


def _run(program: Jaxpr, constants: Sequence[Any], arguments: Sequence[Any]) -> list[Any]:
    """The program's results, operation by operation, as JAX itself interprets it."""
    known = dict(zip((*program.constvars, *program.invars), (*constants, *arguments), strict=True))

    def read(variable: Any) -> Any:
        return variable.val if isinstance(variable, Literal) else known[variable]

    for equation in program.eqns:
        found = _apply(equation, [read(variable) for variable in equation.invars])
        known.update(zip(equation.outvars, found, strict=True))
    return [read(variable) for variable in program.outvars]


def _apply(equation: JaxprEqn, inputs: list[Any]) -> list[Any]:
    primitive, parameters = equation.primitive, equation.params
    if primitive in WITH_RULES:  # differentiated already: the rule is of no use any more
        inner = parameters["call_jaxpr"]
        return _run(inner.jaxpr, inner.consts, inputs)
    if primitive is dot_general_p and _is_large(equation):
        low = [x.astype(jnp.bfloat16) for x in inputs]
        return [primitive.bind(*low, **parameters | {"preferred_element_type": jnp.float32})]
    parameters = {name: _inside(value) for name, value in parameters.items()}
    results = primitive.bind(*inputs, **parameters)
    return list(results) if primitive.multiple_results else [results]


def _is_large(product: JaxprEqn) -> bool:
    """Whether rows, columns and terms of a float32 product are all worth it."""
    matrices: list[Any] = [variable.aval for variable in product.invars]
    if any(matrix.dtype != jnp.float32 for matrix in matrices):
        return False
    contracted, batch = product.params["dimension_numbers"]
    sides = [[matrices[0].shape[axis] for axis in contracted[0]]]
    for matrix, summed, shared in zip(matrices, contracted, batch, strict=True):
        sides.append([n for axis, n in enumerate(matrix.shape) if axis not in (*summed, *shared)])
    return all(math.prod(side) >= SMALL for side in sides)


def _inside(value: Any) -> Any:
    """The same for the programs that an operation such as a loop holds among its parameters."""
    if isinstance(value, ClosedJaxpr):
        rewritten = jax.make_jaxpr(lambda *inputs: _run(value.jaxpr, value.consts, inputs))
        return rewritten(*value.in_avals)
    if isinstance(value, Jaxpr):
        return _inside(ClosedJaxpr(value, ())).jaxpr
    if isinstance(value, tuple) and any(isinstance(each, ClosedJaxpr) for each in value):
        return jax.tree.map(_inside, value, is_leaf=lambda each: each is not value)
    return value
