"""Counts the floating-point operations of matrix products in a function."""

import math
from collections.abc import Callable
from typing import Any

import jax

Jaxpr = Any  # JAX gives its programs no public type


def matmul_flops(function: Callable[..., Any], *arguments: Any) -> float:
    """Counts the operations of one call on all devices; a scan counts once for each repetition.

    A product of `[n, k]` and `[k, m]` counts 2 n k m, a convolution as the equivalent product.

    Args:
        function: function to count, jitted or not; it is traced, not run.
        arguments: its arguments: arrays, or their shapes.
    """
    jitted = function if hasattr(function, "trace") else jax.jit(function)
    return _count(jitted.trace(*arguments).jaxpr.jaxpr)


def _count(jaxpr: Jaxpr) -> float:
    total = 0.0
    for equation in jaxpr.eqns:
        name, params = equation.primitive.name, equation.params
        shapes: list[Any] = [getattr(operand.aval, "shape", ()) for operand in equation.invars]
        results = sum(math.prod(getattr(out.aval, "shape", ())) for out in equation.outvars)
        if name == "dot_general":
            (axes, _), _ = params["dimension_numbers"]
            total += 2 * results * math.prod(shapes[0][axis] for axis in axes)
        elif name == "conv_general_dilated":
            out = params["dimension_numbers"].rhs_spec[0]
            total += 2 * results * math.prod(shapes[1]) / shapes[1][out]
        times = 1
        if name == "scan":
            times = params["length"]
        elif name == "shard_map":
            times = params["mesh"].size
        total += times * sum(map(_count, inner_programs(list(params.values()))))
    return total


def inner_programs(values: list[Any]) -> list[Jaxpr]:
    """Finds the programs among the parameters of an operation, with or without constants."""
    found = []
    for value in values:
        if isinstance(value, tuple | list):
            found += inner_programs(list(value))
        elif hasattr(value, "jaxpr"):  # a program with its constants
            found.append(value.jaxpr)
        elif hasattr(value, "eqns"):
            found.append(value)
    return found
