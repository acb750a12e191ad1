"""Logical axes of parameters and activations, and the mesh axes that they are split over.

A dimension has a name that says what it is; ``AXIS_RULES`` says which mesh axes such a dimension is split over. Meshes
have the axes `data` (the batch is split, parameters are copied), `fsdp` (the batch is split, and so is every parameter,
which is gathered a layer at a time where it is used: Zhao et al. 2023, "PyTorch FSDP"; Rajbhandari et al. 2020, "ZeRO",
stage 3) and `tensor` (the hidden width of each layer is split: Shoeybi et al. 2019, "Megatron-LM").
"""

import math
from collections.abc import Callable
from typing import TypeVar

import jax
from jax.sharding import AbstractMesh, Mesh, NamedSharding, PartitionSpec

from dsvla_jax.types import Array

Tree = TypeVar("Tree")

MESH_AXES = ("data", "fsdp", "tensor")

AXIS_RULES: dict[str, tuple[str, ...]] = {
    "batch": ("data", "fsdp"),
    "embed": ("fsdp",),
    "hidden": ("tensor",),
    "adapter": ("tensor", "fsdp"),
    "vocab": ("tensor",),
}

# The last dimensions of a linear layer's kernel by the layer's name; those of any other are ("embed", None).
_INTO_HIDDEN, _OUT_OF_HIDDEN = ("embed", "hidden"), ("hidden", "embed")
_KERNELS = dict.fromkeys(("q", "k", "v", "gate", "up"), _INTO_HIDDEN) | {
    "o": _OUT_OF_HIDDEN,
    "down": _OUT_OF_HIDDEN,
}

# Those of the other parameters. What is not named is copied to every device: norms, biases and gates are small.
_PARAMETERS = {
    "embedding": ("vocab", "embed"),
    "output": ("embed", "vocab"),
    "patch_kernel": ("embed",),
    "positional_embedding": ("embed",),
    "camera_embedding": ("embed",),
    "projection": ("embed", None),
    "adapter_query": ("embed",),
    "visual_query": ("embed",),
}


def logical_axes(path: tuple[str, ...]) -> tuple[str | None, ...]:
    """Names of the last dimensions of the variable whose path ends so; dimensions in front of them have none."""
    layer, name = ("", "", *path)[-2:]
    kernel = _KERNELS.get(layer, ("embed", None))
    # An adapter's matrices have one long side: over all of the mesh that a kernel's two sides are split over.
    a, b = ("adapter" if side == "hidden" else side for side in kernel)
    by_name = {"kernel": kernel, "kernel_scale": (kernel[1],), "a": (a, None), "b": (None, b)}
    return by_name.get(name) or _PARAMETERS.get(name, ())


def partition_spec(axes: tuple[str | None, ...], shape: tuple[int, ...], mesh: Mesh | AbstractMesh) -> PartitionSpec:
    """The spec of an array whose dimensions have these names; one that its mesh axes do not divide is not split."""

    def split(size: int, name: str | None) -> tuple[str, ...] | None:
        over = tuple(axis for axis in AXIS_RULES.get(name or "", ()) if axis in mesh.shape)
        return over if over and size % math.prod(mesh.shape[axis] for axis in over) == 0 else None

    return PartitionSpec(*map(split, shape, axes))


def shardings(tree: object, mesh: Mesh) -> object:
    """The tree with a NamedSharding for each leaf; the leaves are variables, or stand at the places of variables.

    That covers a whole training state: the moments of an optimizer have the paths of the parameters they belong to.
    """

    def of(path: jax.tree_util.KeyPath, leaf: Array) -> NamedSharding:
        axes = logical_axes(tuple(key.key for key in path if isinstance(key, jax.tree_util.DictKey)))
        axes = axes if len(axes) <= len(leaf.shape) else ()
        names = (None,) * (len(leaf.shape) - len(axes)) + axes
        return NamedSharding(mesh, partition_spec(names, leaf.shape, mesh))

    return jax.tree_util.tree_map_with_path(of, tree)


def make_sharded(make: Callable[..., Tree], mesh: Mesh, *arguments: object) -> Tree:
    """``make(*arguments)``, a pure function of arrays, with every leaf of its result made split over the mesh."""
    return jax.jit(make, out_shardings=shardings(jax.eval_shape(make, *arguments), mesh))(*arguments)


def constrain(x: Array, *axes: str | None) -> Array:
    """The same array, split by the names of its first dimensions over the mesh in use (``jax.set_mesh``), if any."""
    mesh = jax.sharding.get_abstract_mesh()
    if mesh.empty:
        return x
    names = axes + (None,) * (x.ndim - len(axes))
    return jax.lax.with_sharding_constraint(x, partition_spec(names, x.shape, mesh))
