"""Kernels of a frozen base in 8 bits: a quarter of float32's memory, half of bfloat16's.

Symmetric, one scale for each output of a layer, no calibration ("absmax"; Dettmers et al. 2022, "LLM.int8()", section
2.1, without its outliers). Products are computed in the model's dtype, so this saves memory and not time.
"""

from collections.abc import Mapping

import jax.numpy as jnp
from flax import traverse_util

from dsvla_jax.model.variables import FlatVariables, Variables, flat_variables
from dsvla_jax.types import Array

KERNEL, SCALE = "kernel", "kernel_scale"
TOWERS = ("vision", "language")
LARGEST = 127


def is_quantized(path: tuple[str, ...]) -> bool:
    """Whether a parameter of this path below "params" is one of the kernels that are kept in 8 bits."""
    return path[:2] in tuple((tower, "layers") for tower in TOWERS) and path[-1] == KERNEL


def quantize_kernel(kernel: Array) -> tuple[Array, Array]:
    """(..., in, out) -> int8 of the same shape, and float32 (..., out): their product is within half a scale of it."""
    kernel = kernel.astype(jnp.float32)
    scale = jnp.abs(kernel).max(axis=-2) / LARGEST
    scale = jnp.where(scale > 0, scale, 1.0)
    return jnp.round(kernel / scale[..., None, :]).astype(jnp.int8), scale


def quantize(params: Variables) -> Variables:
    """A model's params with the kernels of both towers' layers in 8 bits, each beside its scale."""
    flat: FlatVariables = {}
    for path, leaf in flat_variables(params).items():
        if is_quantized(path):
            flat[path], flat[(*path[:-1], SCALE)] = quantize_kernel(leaf)
        else:
            flat[path] = leaf
    return traverse_util.unflatten_dict(flat)


def dequantize(params: Mapping) -> Variables:
    """The inverse of `quantize` but for rounding, float32; params without 8-bit kernels stay as they are."""
    flat = flat_variables(params)
    for path in [path for path in flat if path[-1] == SCALE]:
        kernel = (*path[:-1], KERNEL)
        flat[kernel] = flat[kernel].astype(jnp.float32) * flat.pop(path)[..., None, :]
    return traverse_util.unflatten_dict(flat)
