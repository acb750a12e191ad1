"""Keyframes as vectors that a network can regress or denoise.

A vector has ten numbers for an arm: the position from an origin, in half sides of the box that positions are counted
in; the first two columns of the rotation matrix, one after the other (Zhou et al. 2019, "On the Continuity of Rotation
Representations in Neural Networks", section 4.2); and the gripper, 1 for open and -1 for closed. The origin of an
answer is where the arm is, so that an answer stays the same when the world is shifted.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from dsvla_jax.encoding.codec import PoseCodec
from dsvla_jax.encoding.vector_scale import VectorScale
from dsvla_jax.geometry.rotations import matrix_to_quaternion, normalize, quaternion_to_matrix
from dsvla_jax.types import Action, Array

VECTOR = 10
POSITION, ROTATION, GRIPPER = slice(0, 3), slice(3, 9), 9
# Two places in a box are at most two half sides from each other.
LARGEST = np.array([2.0] * 3 + [1.0] * 7, np.float32)


def center(codec: PoseCodec) -> Float[Array, "3"]:
    """The middle of the codec's box, metres, world frame."""
    return jnp.array([(low + high) / 2 for low, high in zip(codec.low, codec.high, strict=True)])


def half_sides(codec: PoseCodec) -> Float[Array, "3"]:
    """Half of each side of the codec's box, metres."""
    return jnp.array([(high - low) / 2 for low, high in zip(codec.low, codec.high, strict=True)])


def scale_position(
    position: Float[Array, "*b 3"], origin: Float[Array, "*c 3"], codec: PoseCodec
) -> Float[Array, "*b 3"]:
    """Positions in metres -> half sides of the codec's box from the origin."""
    return (position - origin) / half_sides(codec)


def to_vectors(
    pose: Float[Array, "*b 7"], gripper_open: Float[Array, "*b"], origin: Float[Array, "*c 3"], codec: PoseCodec
) -> Float[Array, "*b 10"]:
    """Keyframes -> vectors. A missing arm, whose pose is zeros, has the rotation of a quaternion of zeros."""
    matrix = quaternion_to_matrix(pose[..., 3:])
    columns = matrix[..., :2].swapaxes(-1, -2).reshape(*matrix.shape[:-2], 6)
    gripper = 2 * gripper_open[..., None] - 1
    return jnp.concatenate([scale_position(pose[..., :3], origin, codec), columns, gripper], axis=-1)


def from_vectors(vectors: Float[Array, "*b 10"], origin: Float[Array, "*c 3"], codec: PoseCodec) -> Action[Array]:
    """The nearest keyframes: positions moved into the box, columns made orthonormal, the gripper open above 0."""
    position = origin + vectors[..., POSITION] * half_sides(codec)
    position = jnp.clip(position, jnp.array(codec.low), jnp.array(codec.high))
    first, second = jnp.split(vectors[..., ROTATION], 2, axis=-1)
    first = normalize(first)
    second = normalize(second - jnp.sum(first * second, axis=-1, keepdims=True) * first)
    matrix = jnp.stack([first, second, jnp.cross(first, second)], axis=-1)
    pose = jnp.concatenate([position, matrix_to_quaternion(matrix)], axis=-1)
    return Action(pose, (vectors[..., GRIPPER] > 0).astype(jnp.float32))


@dataclasses.dataclass(frozen=True)
class VectorSpace:
    """What a network's vectors count in: half sides of the codec's box, and then the range of the data, if fitted."""

    codec: PoseCodec
    scale: VectorScale | None = None

    @property
    def largest(self) -> np.ndarray:
        """float32 (10,): the largest absolute value of each number."""
        return LARGEST if self.scale is None else np.ones(VECTOR, np.float32)

    def to_vectors(
        self, pose: Float[Array, "*b 7"], gripper_open: Float[Array, "*b"], origin: Float[Array, "*c 3"]
    ) -> Float[Array, "*b 10"]:
        """See `to_vectors`."""
        vectors = to_vectors(pose, gripper_open, origin, self.codec)
        return vectors if self.scale is None else self.scale.to_unit(vectors)

    def from_vectors(self, vectors: Float[Array, "*b 10"], origin: Float[Array, "*c 3"]) -> Action[Array]:
        """See `from_vectors`."""
        return from_vectors(vectors if self.scale is None else self.scale.from_unit(vectors), origin, self.codec)
