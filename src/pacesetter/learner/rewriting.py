"""A finished program, gradients included, with some of its operations made another way."""

from collections.abc import Callable, Sequence
from typing import Any, ParamSpec, TypeVar

import jax
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal
from jax.extend.core.primitives import custom_jvp_call_p, custom_vjp_call_p

P = ParamSpec("P")
R = TypeVar("R")
Change = Callable[[JaxprEqn, list[Any]], Any]  # another result of an operation, or None
WITH_RULES = (custom_jvp_call_p, custom_vjp_call_p)


def rewritten(function: Callable[P, R], change: Change) -> Callable[P, R]:
    """`function` whose operations give what `change(operation, inputs)` gives, unless None.

    Learners know nothing of it, and operations inside loops and branches are changed too.
    """

    def changed(*arguments: P.args, **named: P.kwargs) -> R:
        program, shape = jax.make_jaxpr(function, return_shape=True)(*arguments, **named)
        inputs = jax.tree.leaves((arguments, named))
        results = _run(program.jaxpr, program.consts, inputs, change)
        return jax.tree.unflatten(jax.tree.structure(shape), results)

    return changed


def _run(
    program: Jaxpr, constants: Sequence[Any], arguments: Sequence[Any], change: Change
) -> list[Any]:
    """The program's results, operation by operation, as JAX itself interprets it."""
    known = dict(zip((*program.constvars, *program.invars), (*constants, *arguments), strict=True))

    def read(variable: Any) -> Any:
        return variable.val if isinstance(variable, Literal) else known[variable]

    for equation in program.eqns:
        found = _apply(equation, [read(variable) for variable in equation.invars], change)
        known.update(zip(equation.outvars, found, strict=True))
    return [read(variable) for variable in program.outvars]


def _apply(equation: JaxprEqn, inputs: list[Any], change: Change) -> list[Any]:
    primitive, parameters = equation.primitive, equation.params
    if primitive in WITH_RULES:  # differentiated already: the rule is of no use any more
        inner = parameters["call_jaxpr"]
        return _run(inner.jaxpr, inner.consts, inputs, change)
    other = change(equation, inputs)
    if other is not None:
        return [other]
    parameters = {name: _inside(value, change) for name, value in parameters.items()}
    results = primitive.bind(*inputs, **parameters)
    return list(results) if primitive.multiple_results else [results]


def _inside(value: Any, change: Change) -> Any:
    """The same for the programs that an operation such as a loop holds among its parameters."""
    if isinstance(value, ClosedJaxpr):
        inner = jax.make_jaxpr(lambda *inputs: _run(value.jaxpr, value.consts, inputs, change))
        return inner(*value.in_avals)
    if isinstance(value, Jaxpr):
        return _inside(ClosedJaxpr(value, ()), change).jaxpr
    if isinstance(value, tuple) and any(isinstance(each, ClosedJaxpr) for each in value):
        return jax.tree.map(
            lambda each: _inside(each, change), value, is_leaf=lambda each: each is not value
        )
    return value
