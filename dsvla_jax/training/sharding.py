"""Where arrays live: the mesh of devices, and how batches, parameters and optimizer state are split over it."""

import dataclasses
from collections.abc import Sequence

import jax
import numpy as np
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

from dsvla_jax.errors import UserError
from dsvla_jax.experiment import MeshConfig
from dsvla_jax.model.partition import AXIS_RULES, MESH_AXES, Tree
from dsvla_jax.training.chips import Device


def make_mesh(config: MeshConfig, devices: Sequence[Device] | None = None) -> Mesh:
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


def put_batch(batch: Tree, mesh: Mesh) -> Tree:
    """Makes global arrays of a batch, split by its leading axis, of which this process holds `batch`.

    batch: a pytree of NumPy arrays.
    """
    sharding = batch_sharding(mesh)
    return jax.tree.map(lambda leaf: jax.make_array_from_process_local_data(sharding, leaf), batch)
