"""Meshes to plan for: the one that a text names, and all that a slice has room for."""

from collections.abc import Iterator

from dsvla_jax.errors import UserError
from dsvla_jax.experiment import Experiment, MeshConfig
from dsvla_jax.model.partition import MESH_AXES
from dsvla_jax.planner.planning import held_bytes
from dsvla_jax.training.chips import Slice
from dsvla_jax.training.sharding import make_mesh


def parse_mesh(text: str) -> MeshConfig:
    """The mesh of a text such as data=1,fsdp=-1; axes that are not named are 1. Raises UserError for other texts."""
    sizes = dict.fromkeys(MESH_AXES, 1)
    for part in text.split(","):
        axis, _, size = part.partition("=")
        if axis not in sizes or not size.removeprefix("-").isdigit():
            raise UserError(f"mesh: expected sizes such as data=1,fsdp=-1,tensor=1; got {text!r}")
        sizes[axis] = int(size)
    return MeshConfig(**sizes)


def candidate_meshes(experiment: Experiment, where: Slice) -> Iterator[MeshConfig]:
    """All meshes of the slice that have room for parameters and optimizer, the most copies first.

    `tensor` goes up to the chips of a host, as far as it divides the attention heads of both towers.
    """
    count = len(where.devices)
    sizes = [size for size in range(1, count + 1) if count % size == 0]
    heads = (experiment.model.language.kv_heads, experiment.model.vision.heads)
    for tensor in (size for size in sizes if size <= 8 and not any(number % size for number in heads)):
        for fsdp in (size for size in sizes if (count // tensor) % size == 0):
            config = MeshConfig(count // tensor // fsdp, fsdp, tensor)
            if held_bytes(experiment, make_mesh(config, where.devices)) < where.chip.memory:
                yield config
