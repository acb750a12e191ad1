"""Keyframes as vectors that a network can regress or denoise.

A vector has ten numbers for an arm: the position, -1 to 1 over the box that positions are counted in; the first two
columns of the rotation matrix, one after the other (Zhou et al. 2019, "On the Continuity of Rotation Representations in
Neural Networks", section 4.2); and the gripper, 1 for open and -1 for closed.
"""

import jax.numpy as jnp
from jaxtyping import Float

from dsvla_jax.encoding.codec import PoseCodec
from dsvla_jax.geometry.rotations import matrix_to_quaternion, normalize, quaternion_to_matrix
from dsvla_jax.types import Action, Array

VECTOR = 10
POSITION, ROTATION, GRIPPER = slice(0, 3), slice(3, 9), 9


def scale_position(position: Float[Array, "*b 3"], codec: PoseCodec) -> Float[Array, "*b 3"]:
    """Positions in metres -> -1 to 1 over the codec's box."""
    low, high = jnp.array(codec.low), jnp.array(codec.high)
    return (position - low) / (high - low) * 2 - 1


def to_vectors(pose: Float[Array, "*b 7"], gripper_open: Float[Array, "*b"], codec: PoseCodec) -> Float[Array, "*b 10"]:
    """Keyframes -> vectors. A missing arm, whose pose is zeros, has the rotation of a quaternion of zeros."""
    matrix = quaternion_to_matrix(pose[..., 3:])
    columns = matrix[..., :2].swapaxes(-1, -2).reshape(*matrix.shape[:-2], 6)
    gripper = 2 * gripper_open[..., None] - 1
    return jnp.concatenate([scale_position(pose[..., :3], codec), columns, gripper], axis=-1)


def from_vectors(vectors: Float[Array, "*b 10"], codec: PoseCodec) -> Action[Array]:
    """The nearest keyframes: positions inside the box, columns made orthonormal, the gripper open above 0."""
    low, high = jnp.array(codec.low), jnp.array(codec.high)
    position = low + (jnp.clip(vectors[..., POSITION], -1, 1) + 1) / 2 * (high - low)
    first, second = jnp.split(vectors[..., ROTATION], 2, axis=-1)
    first = normalize(first)
    second = normalize(second - jnp.sum(first * second, axis=-1, keepdims=True) * first)
    matrix = jnp.stack([first, second, jnp.cross(first, second)], axis=-1)
    pose = jnp.concatenate([position, matrix_to_quaternion(matrix)], axis=-1)
    return Action(pose, (vectors[..., GRIPPER] > 0).astype(jnp.float32))
