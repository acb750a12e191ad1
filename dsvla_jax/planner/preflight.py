"""What can be known of a training step before anything is read, written or compiled: that its sizes fit, and memory."""

import math
import os
import resource
from collections.abc import Iterator
from pathlib import Path

import jax
import jax.core
import jax.extend.core
from jax.sharding import Mesh

from dsvla_jax.errors import UserError
from dsvla_jax.experiment import Experiment
from dsvla_jax.model.variables import Variables, join_variables
from dsvla_jax.planner.planning import abstract_batch, abstract_state, bytes_on_a_device, planning_learner
from dsvla_jax.types import Array


def check_step(experiment: Experiment, mesh: Mesh, picture: tuple[int, int]) -> None:
    """Traces the network on a batch of shapes, which takes a second or two and allocates nothing.

    picture: height and width of the pictures that the run learns from.
    Raises UserError where the sizes of the config do not fit together, or cannot fit the devices' memory: what is
    counted is a lower bound, so a step that passes may still be too large.
    """
    state, frozen, _ = abstract_state(experiment, mesh)
    memory = device_memory()
    # The gradient of everything that is trained is there when the optimizer measures its norm.
    held = bytes_on_a_device((state, frozen, state.trainable))
    if held > memory:
        raise UserError(
            f"model: parameters, gradient and optimizer take {_gib(held)} of each device, which has {_gib(memory)}; use"
            " a smaller model, regime lora, or split them over more devices (--mesh.fsdp)"
        )
    batch = abstract_batch(experiment, mesh, picture)

    learner = planning_learner(experiment)

    def loss(trainable: Variables, frozen: Variables, batch: object) -> Array:
        return learner.loss(join_variables(trainable, frozen), batch, learner.totals(batch), jax.random.key(0))[0]

    largest = max(_outputs(jax.make_jaxpr(loss)(state.trainable, frozen, batch).jaxpr), key=_bytes)
    # A batch is computed in parts, and at best every array is split over all devices.
    needed = _bytes(largest) / experiment.gradient_accumulation / mesh.size
    if needed > memory:
        raise UserError(
            f"batch_size: an array of shape {largest.shape} of one step takes {_gib(needed)} of each device, which "
            f"has {_gib(memory)}; lower --batch-size or other sizes, or raise --gradient-accumulation"
        )


def device_memory() -> float:
    """Bytes of one device; for processors of the memory that this process may have, shared by them; inf if unknown."""
    devices = jax.local_devices()
    if limit := (devices[0].memory_stats() or {}).get("bytes_limit"):
        return limit
    if devices[0].platform != "cpu":
        return math.inf
    machine = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return min([machine, *_limits()]) / len(devices)


def _limits() -> Iterator[int]:
    """Bytes that `ulimit -v`, a container or a cluster's job allows this process, where they set a limit."""
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    if limit != resource.RLIM_INFINITY:
        yield limit
    groups = Path("/proc/self/cgroup")
    for line in groups.read_text().splitlines() if groups.exists() else ():
        _, controllers, group = line.split(":", 2)
        folder = Path("/sys/fs/cgroup")
        if not controllers:
            file = folder / group.lstrip("/") / "memory.max"
        elif "memory" in controllers.split(","):
            file = folder / "memory" / group.lstrip("/") / "memory.limit_in_bytes"
        else:
            continue
        if file.exists() and (limit := file.read_text().strip()) != "max":
            yield int(limit)


def _outputs(jaxpr: jax.extend.core.Jaxpr) -> Iterator[jax.core.ShapedArray]:
    """The shapes of all that a program computes, inner programs included."""
    for equation in jaxpr.eqns:
        avals = (variable.aval for variable in equation.outvars)
        yield from (aval for aval in avals if isinstance(aval, jax.core.ShapedArray))
        for parameter in jax.tree.leaves(list(equation.params.values()), is_leaf=_is_program):
            if _is_program(parameter):
                yield from _outputs(getattr(parameter, "jaxpr", parameter))


def _is_program(value: object) -> bool:
    return isinstance(value, (jax.extend.core.Jaxpr, jax.extend.core.ClosedJaxpr))


def _bytes(aval: jax.core.ShapedArray) -> int:
    return math.prod(aval.shape) * getattr(aval.dtype, "itemsize", 4)


def _gib(count: float) -> str:
    return f"{count / 2**30:,.1f} GiB"
