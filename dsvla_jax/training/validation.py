"""How near the answers to held-out demonstrations come: the loss, and the error of the poses that they name.

Teacher-forced: every token is predicted after the right ones before it, in one pass. Of the tokens that a number may go
on with, the most probable is taken, as decoding does. Where an integer is several tokens, the first wrong one decides:
the number counts as the nearest to the right one that it leads to, so that errors are lower bounds. A gripper state is
right if its token is the most probable of all.
"""

from collections.abc import Iterable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Float, Int

from dsvla_jax.encoding.codec import QUATERNION_VALUES, VALUES_PER_ARM, PoseCodec
from dsvla_jax.encoding.encode import model_inputs
from dsvla_jax.encoding.number_targets import NumberTargets
from dsvla_jax.experiment import Experiment
from dsvla_jax.geometry.rotations import rotation_distance
from dsvla_jax.model.partition import constrain
from dsvla_jax.model.variables import Variables, join_variables
from dsvla_jax.model.vla import VLA
from dsvla_jax.training.objective import answer_loss
from dsvla_jax.training.sharding import put_batch
from dsvla_jax.types import Array, HeldOutExample

_GRIPPER = VALUES_PER_ARM - 1
_BINS = slice(0, _GRIPPER)


def jit_validation(experiment: Experiment, targets: NumberTargets, mesh: Mesh) -> Any:
    """Compiles ``sums(trainable, frozen, batch)`` for a mesh.

    It returns, by name, a figure's sum over a batch and over how many (`mean_errors`). The batch is of
    `data_pipelines.samples.make_validation_sampler`.
    """
    model = VLA(experiment.model)

    def sums(trainable: Variables, frozen: Variables, batch: HeldOutExample[Array]) -> dict[str, tuple[Array, Array]]:
        with jax.sharding.use_abstract_mesh(mesh.abstract_mesh):
            batch = jax.tree.map(lambda leaf: constrain(leaf, "batch"), batch)
            example = batch.example
            inputs = model_inputs(example.pictures, example.text, experiment.encoding)
            logits: Any = model.apply(join_variables(trainable, frozen), inputs)
            one = jnp.ones((), jnp.int32)
            loss, _ = answer_loss(logits, example, targets, (one, one))
            tokens = example.answer_mask[:, 1:].sum()
            return {
                "loss": (loss, tokens),
                **number_errors(guess_integers(logits, batch, targets), batch, experiment.encoding.codec),
            }

    return jax.jit(sums, out_shardings=NamedSharding(mesh, PartitionSpec()))


def guess_integers(
    logits: Float[Array, "b t v"], batch: HeldOutExample[Array], targets: NumberTargets
) -> Int[Array, "b 2 8"]:
    """Reads the most probable answers off the logits of a validation batch, as `integers` in it."""
    labels, rows = batch.example.text.tokens[:, 1:], batch.example.number_rows[:, 1:]
    number_of = batch.number_of[:, 1:]
    logits = logits[:, :-1]
    offsets = jnp.asarray(targets.offsets)[rows]
    choice = jnp.where(jnp.isfinite(offsets), logits[..., targets.tokens], -jnp.inf).argmax(-1)
    # How far off a token leads; no further than 0 where there is nothing to choose.
    off = jnp.where(rows > 0, jnp.take_along_axis(offsets, choice[..., None], axis=-1)[..., 0], 0)
    # A gripper status is no bin: it is the other one where a token of it is wrong.
    wrong = (number_of > 0) & (rows == 0) & (logits.argmax(-1) != labels)

    integers = batch.integers.reshape(len(labels), -1)
    belongs = number_of[:, None] == 1 + jnp.arange(integers.shape[1])[:, None]
    # Of a number without a wrong token this is the first of the text, which belongs to none.
    first = (belongs & (off != 0)[:, None]).argmax(-1)
    guess = (integers + jnp.take_along_axis(off, first, axis=1).astype(jnp.int32)).reshape(-1, 2, VALUES_PER_ARM)
    status = batch.integers[..., _GRIPPER]
    flipped = (belongs & wrong[:, None]).any(-1).reshape(-1, 2, VALUES_PER_ARM)[..., _GRIPPER]
    return guess.at[..., _GRIPPER].set(jnp.where(flipped, 1 - status, status))


def number_errors(
    guess: Int[Array, "b 2 8"], batch: HeldOutExample[Array], codec: PoseCodec
) -> dict[str, tuple[Array, Array]]:
    """Sums the errors of guessed integers over the arms of a validation batch, and counts the arms."""
    target = batch.integers
    there = batch.number_of.max(axis=1)[:, None] > VALUES_PER_ARM * jnp.arange(2)  # (B, 2)
    # Whatever real part other than 0 stands beside three zeros, it is no turn.
    rotation = guess[..., QUATERNION_VALUES]
    none = (rotation == 0).all(-1)
    guess = guess.at[..., QUATERNION_VALUES.stop - 1].add(none.astype(guess.dtype))
    off = jnp.abs(guess - target)[..., _BINS]
    reached, wanted = codec.decode(guess), codec.decode(target)
    errors = {
        "bin_exact": (off == 0).mean(-1),
        "bin_within_one": (off <= 1).mean(-1),
        "position_cm": 100 * jnp.linalg.norm(reached.pose[..., :3] - wanted.pose[..., :3], axis=-1),
        "rotation_degrees": jnp.degrees(rotation_distance(reached.pose[..., 3:], wanted.pose[..., 3:])),
        "gripper": (guess[..., _GRIPPER] == target[..., _GRIPPER]).astype(jnp.float32),
    }
    return {name: (jnp.where(there, error, 0).sum(), there.sum()) for name, error in errors.items()}


def mean_errors(
    sums: Any, trainable: Variables, frozen: Variables, batches: Iterable[HeldOutExample[np.ndarray]], mesh: Mesh
) -> dict[str, float]:
    """Returns the means over all batches, by name.

    They are validation/loss, bin_exact, bin_within_one, position_cm, rotation_degrees and gripper.

    sums: of `jit_validation`. batches: this process's parts, on the host.
    """
    total: dict[str, np.ndarray] = {}
    for batch in batches:
        for name, pair in jax.device_get(sums(trainable, frozen, put_batch(batch, mesh))).items():
            total[name] = total.get(name, 0) + np.asarray(pair, np.float64)
    return {f"validation/{name}": float(value / max(count, 1)) for name, (value, count) in total.items()}
