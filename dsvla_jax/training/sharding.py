"""Where arrays live: batches are split over the devices, parameters are copied to each."""

from typing import TypeVar

import jax
from jax.sharding import AxisType, NamedSharding, PartitionSpec

Tree = TypeVar("Tree")


def make_mesh() -> jax.sharding.Mesh:
    """All devices along one axis, `data`."""
    return jax.make_mesh((jax.device_count(),), ("data",), axis_types=(AxisType.Auto,))


def batch_sharding() -> NamedSharding:
    """Leading axis over `data`."""
    return NamedSharding(make_mesh(), PartitionSpec("data"))


def replicate(tree: Tree) -> Tree:
    """The tree with every leaf on every device."""
    return jax.device_put(tree, NamedSharding(make_mesh(), PartitionSpec()))
