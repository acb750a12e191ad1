"""Floating-point operations of the matrix products and convolutions of a traced program."""

import math

import jax.core
import jax.extend.core


def product_flops(jaxpr: jax.extend.core.Jaxpr) -> int:
    """Counts 2 m k n for every product (m, k) with (k, n), the bodies of loops as often as they run.

    A loop whose length is not known counts once.
    """
    total = 0
    for equation in jaxpr.eqns:
        if equation.primitive.name == "dot_general":
            (left, _), _ = equation.params["dimension_numbers"]
            size = _shape(equation.invars[0].aval)
            total += 2 * math.prod(_shape(equation.outvars[0].aval)) * math.prod(size[axis] for axis in left)
        if equation.primitive.name == "conv_general_dilated":
            kernel, numbers = _shape(equation.invars[1].aval), equation.params["dimension_numbers"]
            inner = math.prod(kernel) // kernel[numbers.rhs_spec[0]]
            total += 2 * math.prod(_shape(equation.outvars[0].aval)) * inner
        times = equation.params.get("length", 1) if equation.primitive.name == "scan" else 1
        for body in jax.extend.core.jaxprs_in_params(equation.params):
            total += times * product_flops(body)
    return total


def _shape(aval: jax.core.AbstractValue) -> tuple[int, ...]:
    assert isinstance(aval, jax.core.ShapedArray)
    return aval.shape
