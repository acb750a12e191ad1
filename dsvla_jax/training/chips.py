"""Chips and their published peaks; TPU slices to compile for, and devices that stand for them where none is there."""

import dataclasses
import importlib.util
import math
import os
import re
from collections.abc import Sequence
from typing import Protocol

import jax
from jax.experimental import topologies

from dsvla_jax.errors import UserError


@dataclasses.dataclass(frozen=True)
class Chip:
    """Published peaks of one chip.

    bfloat16 products a second, bytes of main memory, bytes a second from it, and to the other chips (all links
    together).
    """

    flops: float
    memory: float
    memory_bandwidth: float
    network_bandwidth: float


# https://cloud.google.com/tpu/docs/v4, /v5e, /v5p, /v6e, "Key chip specifications"; bits of the interconnect over 8.
CHIPS = {
    "v4": Chip(275e12, 32e9, 1228e9, 300e9),
    "v5e": Chip(197e12, 16e9, 819e9, 200e9),
    "v5p": Chip(459e12, 95e9, 2765e9, 600e9),
    "v6e": Chip(918e12, 32e9, 1640e9, 448e9),
}

# By the name that JAX gives a device. GPUs: dense bfloat16 products of the data sheets (https://www.nvidia.com, "A100
# Tensor Core GPU", "H100 Tensor Core GPU", "H200 Tensor Core GPU"), which for the latter two are half of what they
# state "with sparsity".
PEAK_FLOPS = {
    "TPU v4": CHIPS["v4"].flops,
    "TPU v5 lite": CHIPS["v5e"].flops,
    "TPU v5": CHIPS["v5p"].flops,
    "TPU v6 lite": CHIPS["v6e"].flops,
    "NVIDIA A100-SXM4-40GB": 312e12,
    "NVIDIA A100-SXM4-80GB": 312e12,
    "NVIDIA A100 80GB PCIe": 312e12,
    "NVIDIA H100 80GB HBM3": 989e12,
    "NVIDIA H200": 989e12,
}


class Device(Protocol):
    """What is read of JAX's devices, whose class has no types."""

    device_kind: str


def peak_flops(devices: Sequence[Device]) -> float | None:
    """bfloat16 products a second of all devices together, as published; None where one of them is not known."""
    peaks = [PEAK_FLOPS.get(device.device_kind) for device in devices]
    return sum(known) if len(known := [peak for peak in peaks if peak is not None]) == len(peaks) else None


@dataclasses.dataclass(frozen=True)
class Slice:
    """devices: compile-only TPU devices, or virtual CPU devices where the TPU compiler is not installed."""

    name: str
    chip: Chip
    devices: tuple[Device, ...]
    virtual: bool


def find_slice(name: str) -> Slice:
    """The slice of a name such as "v5e:4x4". Has to be called before JAX is used for the first time.

    Raises UserError where there is no such slice.
    """
    kind, _, sizes = name.partition(":")
    if kind not in CHIPS or not re.fullmatch(r"\d+(x\d+)+", sizes):
        raise UserError(
            f"topology: expected a chip of {', '.join(CHIPS)} and the sizes of a slice, e.g. v5e:4x4; got {name!r}"
        )
    count = math.prod(map(int, sizes.split("x")))
    jax.config.update("jax_platforms", "cpu")
    if importlib.util.find_spec("libtpu") is None:
        jax.config.update("jax_num_cpu_devices", count)
        return Slice(name, CHIPS[kind], tuple(jax.devices()), virtual=True)
    # Without these it asks the cloud's metadata service which slice it runs on, and waits for the answer.
    os.environ.setdefault("TPU_SKIP_MDS_QUERY", "1")
    os.environ.setdefault("TPU_STDERR_LOG_LEVEL", "3")
    # It would hold a lock, for the chips that it does not use here.
    os.environ.setdefault("ALLOW_MULTIPLE_LIBTPU_LOAD", "1")
    try:
        topology = topologies.get_topology_desc(platform="tpu", topology_name=name)
    except (jax.errors.JaxRuntimeError, RuntimeError) as error:
        raise UserError(f"topology: there is no slice {name!r}: {str(error).splitlines()[0]}") from error
    return Slice(name, CHIPS[kind], tuple(topology.devices), virtual=False)
