"""Floating-point operations of the matrix products and convolutions of a traced program."""

import math
from typing import Any

import jax.extend.core


def product_flops(jaxpr: Any) -> int:
    """Counts 2 m k n for every product (m, k) with (k, n), the bodies of loops as often as they run.

    jaxpr: of `jax.make_jaxpr`, untyped because the types of its variables have no shapes.
    A loop whose length is not known counts once.
    """
    total = 0
    for equation in jaxpr.eqns:
        if equation.primitive.name == "dot_general":
            (left, _), _ = equation.params["dimension_numbers"]
            inner = math.prod(equation.invars[0].aval.shape[axis] for axis in left)
            total += 2 * math.prod(equation.outvars[0].aval.shape) * inner
        if equation.primitive.name == "conv_general_dilated":
            kernel, numbers = equation.invars[1].aval.shape, equation.params["dimension_numbers"]
            inner = math.prod(kernel) // kernel[numbers.rhs_spec[0]]
            total += 2 * math.prod(equation.outvars[0].aval.shape) * inner
        times = equation.params.get("length", 1) if equation.primitive.name == "scan" else 1
        for body in jax.extend.core.jaxprs_in_params(equation.params):
            total += times * product_flops(body)
    return total
