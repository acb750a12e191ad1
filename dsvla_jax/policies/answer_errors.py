"""How near the answers to held-out demonstrations come: the error of the poses that they name.

Teacher-forced: every token is predicted after the right ones before it, in one pass. Of the tokens that a number may go
on with, the most probable is taken, as decoding does. Where an integer is several tokens, the first wrong one decides:
the number counts as the nearest to the right one that it leads to, so that errors are lower bounds. A gripper state is
right if its token is the most probable of all.
"""

import jax.numpy as jnp
from jaxtyping import Float, Int

from dsvla_jax.encoding.codec import QUATERNION_VALUES, VALUES_PER_ARM, PoseCodec
from dsvla_jax.encoding.number_targets import NumberTargets
from dsvla_jax.geometry.rotations import rotation_distance
from dsvla_jax.types import Array, HeldOutExample

_GRIPPER = VALUES_PER_ARM - 1
_BINS = slice(0, _GRIPPER)


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
