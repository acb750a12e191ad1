"""How near a policy comes to held-out demonstrations while it is trained."""

from collections.abc import Iterable
from typing import Never, TypeVar

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from dsvla_jax.model.partition import constrain
from dsvla_jax.model.variables import Variables, join_variables
from dsvla_jax.policies.interface import Learner
from dsvla_jax.training.sharding import put_batch
from dsvla_jax.types import Array

HeldOut = TypeVar("HeldOut")


def jit_validation(learner: Learner[Never, HeldOut], mesh: Mesh) -> jax.stages.Wrapped:
    """Compiles ``sums(trainable, frozen, batch, key)``, `Learner.errors`, for a mesh. `mean_errors` takes the means."""

    def sums(trainable: Variables, frozen: Variables, batch: HeldOut, key: Array) -> dict[str, tuple[Array, Array]]:
        with jax.sharding.use_abstract_mesh(mesh.abstract_mesh):
            batch = jax.tree.map(lambda leaf: constrain(leaf, "batch"), batch)
            return learner.errors(join_variables(trainable, frozen), batch, key)

    return jax.jit(sums, out_shardings=NamedSharding(mesh, PartitionSpec()))


def mean_errors(
    sums: jax.stages.Wrapped, trainable: Variables, frozen: Variables, batches: Iterable[object], mesh: Mesh
) -> dict[str, float]:
    """Returns the means over all batches, each named "validation/" and as `Learner.errors` names it.

    sums: of `jit_validation`. batches: this process's parts, on the host. The same batches have the same noise.
    """
    total: dict[str, np.ndarray] = {}
    for number, batch in enumerate(batches):
        errors = sums(trainable, frozen, put_batch(batch, mesh), jax.random.key(number))
        for name, pair in jax.device_get(errors).items():
            total[name] = total.get(name, 0) + np.asarray(pair, np.float64)
    return {f"validation/{name}": float(value / max(count, 1)) for name, (value, count) in total.items()}
