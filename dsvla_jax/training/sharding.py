"""Where arrays live: the mesh of devices, and how batches, parameters and optimizer state are split over it."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

from dsvla_jax.errors import UserError
from dsvla_jax.model.partition import AXIS_RULES, MESH_AXES
from dsvla_jax.ranges import at_least, check_fields


@dataclasses.dataclass(frozen=True)
class MeshConfig:
    """How many devices lie along each axis of the mesh. The default suits models that fit one device.

    One axis may be -1: it takes the devices that the others leave.
    """

    data: int = -1
    """Devices that split the batch and hold whole copies of the parameters; -1 for all that the other axes leave."""
    fsdp: int = 1
    """Devices that split the batch, the parameters and the optimizer state; -1 for all that the other axes leave."""
    tensor: int = 1
    """Devices that split the hidden width of each layer; keep them within one host. -1 for all that the other axes
    leave."""

    def __post_init__(self) -> None:
        sizes = {axis: getattr(self, axis) for axis in MESH_AXES}
        check_fields(self, "mesh", **dict.fromkeys(sizes, at_least(-1)))
        named = ", ".join(f"{axis}={size}" for axis, size in sizes.items())
        if list(sizes.values()).count(-1) > 1 or 0 in sizes.values():
            raise UserError(f"mesh: expected positive sizes, and -1 (the rest) for one axis at most; got {named}")

    def shape(self, devices: int) -> tuple[int, int, int]:
        """Sizes of the axes on so many devices. Raises UserError where they do not multiply to it."""
        sizes = [self.data, self.fsdp, self.tensor]
        named = ", ".join(f"{axis}={size}" for axis, size in zip(MESH_AXES, sizes, strict=True))
        known = math.prod(size for size in sizes if size != -1)
        if devices % known or (-1 not in sizes and known != devices):
            raise UserError(
                f"mesh: {named} cannot be laid over {devices} devices; choose sizes with a product of {devices} "
                "(-1 for the rest), e.g. --mesh.data -1 --mesh.fsdp 1 --mesh.tensor 1"
            )
        data, fsdp, tensor = (devices // known if size == -1 else size for size in sizes)
        return data, fsdp, tensor


def make_mesh(config: MeshConfig, devices: Sequence[Any] | None = None) -> Mesh:
    """The mesh over these devices, all there are by default."""
    shape = config.shape(jax.device_count() if devices is None else len(devices))
    return jax.make_mesh(shape, MESH_AXES, axis_types=(AxisType.Auto,) * 3, devices=devices)


def batch_sharding(mesh: Mesh) -> NamedSharding:
    """Leading axis over `data` and `fsdp`."""
    return NamedSharding(mesh, PartitionSpec(AXIS_RULES["batch"]))


@dataclasses.dataclass(frozen=True)
class BatchPart:
    """What one process reads of every batch: part ``index`` of ``count`` equal parts, ``size`` examples long."""

    index: int
    count: int
    size: int


def batch_part(mesh: Mesh, batch_size: int, accumulation: int = 1) -> BatchPart:
    """This process's part of a batch; processes whose devices differ along `tensor` alone read the same part.

    Raises UserError where the batch does not divide over the mesh, or a device's share over the accumulated parts.
    """
    parts = mesh.shape["data"] * mesh.shape["fsdp"]
    if batch_size % (parts * accumulation):
        times = f" x gradient_accumulation {accumulation}" if accumulation > 1 else ""
        below, step = batch_size // (parts * accumulation), parts * accumulation
        near = " or ".join(str(size) for size in (below * step, (below + 1) * step) if size)
        raise UserError(
            f"batch_size: {batch_size} does not divide over {parts} parts (mesh data {mesh.shape['data']} x fsdp "
            f"{mesh.shape['fsdp']}){times}; use --batch-size {near}, or another --mesh"
        )
    processes = np.vectorize(lambda device: device.process_index)(mesh.devices)
    index, count = part_of_process(processes.reshape(parts, -1), jax.process_index())
    return BatchPart(index, count, batch_size // count)


def part_of_process(processes: np.ndarray, process: int) -> tuple[int, int]:
    """Which part of every batch a process reads, and of how many: (index, count).

    processes: int (rows, copies), the process that each row of the batch lives in; copies differ along `tensor`. The
        rows of one process need not be neighbours: on a torus of chips those of a host rarely are.
    Raises UserError where the processes' rows are neither the same nor apart, or are not equally many.
    """
    rows = {int(one): frozenset(np.nonzero((processes == one).any(axis=1))[0].tolist()) for one in np.unique(processes)}
    parts = sorted(set(rows.values()), key=min)
    if len({len(part) for part in parts}) > 1 or sum(map(len, parts)) != len(processes):
        raise UserError(
            "mesh: the processes cannot share a batch in equal parts on it; choose sizes of fsdp and tensor that "
            "divide the devices of one process, or are multiples of them"
        )
    return parts.index(rows[process]), len(parts)


def put_batch(batch: dict[str, np.ndarray], mesh: Mesh) -> dict[str, jax.Array]:
    """This process's part of a batch as a part of the one array that all processes share, split by its leading axis."""
    sharding = batch_sharding(mesh)
    return {name: jax.make_array_from_process_local_data(sharding, value) for name, value in batch.items()}
