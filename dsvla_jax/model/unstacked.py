"""A model's weights as a CPU reads them quickest: every layer's kernels in arrays of their own, a row for each output.

A loop over stacked layers copies each layer's kernels out of the stack before it multiplies, and XLA's CPU products of
few rows are slow where a kernel has its inputs in rows. At a decoder's few tokens a pass, both together take as long as
the products themselves. `unstack_layers` is done once, outside of `jax.jit`; `stack_layers` inside of it stacks the
kernels again, which costs nothing if the loop over layers is unrolled: XLA reads the parts where they are.
"""

import jax
import jax.numpy as jnp
from flax import struct, traverse_util

from dsvla_jax.model.variables import Variables, flat_variables
from dsvla_jax.types import Array


@struct.dataclass
class Kernels:
    """A stack (layers, in, out) as a tuple of one (out, in) a layer."""

    layers: tuple[Array, ...]


def unstack_layers(variables: Variables) -> Variables:
    """The same variables with the floating-point kernels of stacked layers as `Kernels`. Not for sharded arrays."""
    leaves = flat_variables(variables)
    flat: dict[tuple[str, ...], Array | Kernels] = dict(leaves)
    for path, leaf in leaves.items():
        if "layers" in path and path[-1] == "kernel" and jnp.issubdtype(leaf.dtype, jnp.floating):
            # One leaf after the other, so that never more than one is there twice.
            flat[path] = Kernels(tuple(jnp.asarray(kernel.T) for kernel in leaf))
    return traverse_util.unflatten_dict(flat)


def is_unstacked(variables: Variables) -> bool:
    """Whether ``unstack_layers`` made them."""
    return any(map(_is_kernels, jax.tree.leaves(variables, is_leaf=_is_kernels)))


def stack_layers(variables: Variables) -> Variables:
    """The variables as the model takes them. Call it where they are used: a loop would be given the stack itself."""

    def stack(leaf: Array | Kernels) -> Array:
        return jnp.stack([kernel.T for kernel in leaf.layers]) if isinstance(leaf, Kernels) else leaf

    return jax.tree.map(stack, variables, is_leaf=_is_kernels)


def _is_kernels(leaf: object) -> bool:
    return isinstance(leaf, Kernels)
