"""Unit quaternions, [x, y, z, w] with the real part last, as in RLBench, and rotation vectors (axis times angle).

Every function takes float arrays with any leading shape, broadcasts, and is differentiable away from its singularities.
Those generic in `NumpyOrJax` compute NumPy's arrays with NumPy, in their own precision: jax.numpy would round float64.
Formulas: https://en.wikipedia.org/wiki/Quaternions_and_spatial_rotation.
"""

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from dsvla_jax.types import Array, NumpyOrJax, library_of

# A half turn about x less a half turn about z: the gripper's approach axis (its own +z) points along world -z.
DOWN = np.array([0.0, 1.0, 0.0, 0.0], np.float32)


def normalize(vector: ArrayLike, epsilon: float = 1e-12) -> Array:
    """Scales the last axis to unit length; a zero vector stays zero."""
    vector = jnp.asarray(vector)
    return vector / jnp.maximum(jnp.linalg.norm(vector, axis=-1, keepdims=True), epsilon)


def quaternion_multiply(left: ArrayLike, right: ArrayLike) -> Array:
    """The rotation ``right`` followed by ``left``. (..., 4) and (..., 4) -> (..., 4)."""
    return hamilton_product(jnp.asarray(left), jnp.asarray(right))


def hamilton_product(left: NumpyOrJax, right: NumpyOrJax) -> NumpyOrJax:
    """`quaternion_multiply` of two arrays of one library."""
    library = library_of(left)
    x1, y1, z1, w1 = library.moveaxis(left, -1, 0)
    x2, y2, z2, w2 = library.moveaxis(right, -1, 0)
    return library.stack(
        [
            w1 * x2 + x1 * w2 + y1 * z2 - z1 * y2,
            w1 * y2 - x1 * z2 + y1 * w2 + z1 * x2,
            w1 * z2 + x1 * y2 - y1 * x2 + z1 * w2,
            w1 * w2 - x1 * x2 - y1 * y2 - z1 * z2,
        ],
        axis=-1,
    )


def quaternion_conjugate(quaternion: ArrayLike) -> Array:
    """The inverse of a unit quaternion. (..., 4) -> (..., 4)."""
    return jnp.asarray(quaternion) * jnp.array([-1.0, -1.0, -1.0, 1.0], jnp.float32)


def quaternion_rotate(quaternion: ArrayLike, vector: ArrayLike) -> Array:
    """Rotates vectors (..., 3) by unit quaternions (..., 4)."""
    quaternion, vector = jnp.asarray(quaternion), jnp.asarray(vector)
    imaginary, real = quaternion[..., :3], quaternion[..., 3:]
    imaginary, vector = jnp.broadcast_arrays(imaginary, vector)
    twice = 2.0 * jnp.cross(imaginary, vector)
    return vector + real * twice + jnp.cross(imaginary, twice)


def quaternion_from_axis_angle(axis: ArrayLike, angle: ArrayLike) -> Array:
    """A turn by ``angle`` (...,) radians about ``axis`` (..., 3) of any non-zero length. -> (..., 4)."""
    half = 0.5 * jnp.asarray(angle)[..., None]
    axis = normalize(jnp.asarray(axis, jnp.float32))
    shape = jnp.broadcast_shapes(axis.shape[:-1], half.shape[:-1])
    return jnp.concatenate(
        [jnp.broadcast_to(axis * jnp.sin(half), (*shape, 3)), jnp.broadcast_to(jnp.cos(half), (*shape, 1))], axis=-1
    )


def rotation_vector_to_quaternion(vector: NumpyOrJax) -> NumpyOrJax:
    """Rotation vectors (..., 3) -> unit quaternions (..., 4)."""
    library = library_of(vector)
    angle = library.linalg.norm(vector, axis=-1, keepdims=True)
    # sin(a / 2) / a, which is 1 / 2 at 0.
    imaginary = vector * library.sinc(angle / (2 * np.pi)) / 2
    return library.concatenate([imaginary, library.cos(angle / 2)], axis=-1)


def quaternion_to_rotation_vector(quaternion: NumpyOrJax) -> NumpyOrJax:
    """Unit quaternions (..., 4) -> rotation vectors (..., 3) of at most half a turn."""
    library = library_of(quaternion)
    real = quaternion[..., 3:]
    imaginary = quaternion[..., :3] * library.where(real < 0, -1.0, 1.0)
    sine = library.linalg.norm(imaginary, axis=-1, keepdims=True)
    angle = 2.0 * library.arctan2(sine, abs(real))
    return imaginary * library.where(sine < 1e-6, 2.0, angle / library.maximum(sine, 1e-6))


def quaternion_to_matrix(quaternion: NumpyOrJax) -> NumpyOrJax:
    """Unit quaternions (..., 4) -> rotation matrices (..., 3, 3)."""
    library = library_of(quaternion)
    x, y, z, w = library.moveaxis(quaternion, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return library.stack([library.stack(row, axis=-1) for row in rows], axis=-2)


def matrix_to_quaternion(matrix: ArrayLike) -> Array:
    """Rotation matrices (..., 3, 3) -> canonical unit quaternions (..., 4).

    Of the four equivalent formulas the one that divides by the largest component is taken (Shepperd's method).
    """
    m = jnp.asarray(matrix)
    m00, m11, m22 = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    # Row i is 4 q_i times the quaternion, so the row whose own entry is largest is the best conditioned.
    rows = jnp.stack(
        [
            jnp.stack(
                [
                    1 + m00 - m11 - m22,
                    m[..., 0, 1] + m[..., 1, 0],
                    m[..., 0, 2] + m[..., 2, 0],
                    m[..., 2, 1] - m[..., 1, 2],
                ],
                axis=-1,
            ),
            jnp.stack(
                [
                    m[..., 0, 1] + m[..., 1, 0],
                    1 - m00 + m11 - m22,
                    m[..., 1, 2] + m[..., 2, 1],
                    m[..., 0, 2] - m[..., 2, 0],
                ],
                axis=-1,
            ),
            jnp.stack(
                [
                    m[..., 0, 2] + m[..., 2, 0],
                    m[..., 1, 2] + m[..., 2, 1],
                    1 - m00 - m11 + m22,
                    m[..., 1, 0] - m[..., 0, 1],
                ],
                axis=-1,
            ),
            jnp.stack(
                [
                    m[..., 2, 1] - m[..., 1, 2],
                    m[..., 0, 2] - m[..., 2, 0],
                    m[..., 1, 0] - m[..., 0, 1],
                    1 + m00 + m11 + m22,
                ],
                axis=-1,
            ),
        ],
        axis=-2,
    )
    best = jnp.argmax(jnp.diagonal(rows, axis1=-2, axis2=-1), axis=-1)
    row = jnp.take_along_axis(rows, best[..., None, None], axis=-2)[..., 0, :]
    return canonical_quaternion(normalize(row))


def quaternion_from_wxyz(quaternion: ArrayLike) -> Array:
    """[w, x, y, z], MuJoCo's order, to [x, y, z, w]. (..., 4) -> (..., 4)."""
    return jnp.roll(jnp.asarray(quaternion), -1, axis=-1)


def quaternion_to_wxyz(quaternion: ArrayLike) -> Array:
    """[x, y, z, w] to [w, x, y, z], MuJoCo's order. (..., 4) -> (..., 4)."""
    return jnp.roll(jnp.asarray(quaternion), 1, axis=-1)


def canonical_quaternion(quaternion: ArrayLike, tolerance: float = 0.0) -> Array:
    """Of q and -q, the same rotation, the one with w >= 0. (..., 4) -> (..., 4).

    With w = 0 (a half turn, such as ``DOWN``) the first of x, y, z that is not zero is made positive. Components whose
    magnitude is at most ``tolerance`` count as zero for this choice, so that noise does not flip half turns.
    """
    quaternion = jnp.asarray(quaternion)
    ordered = quaternion_to_wxyz(quaternion)
    significant = jnp.where(jnp.abs(ordered) > tolerance, jnp.sign(ordered), 0.0)
    w, x, y, z = jnp.moveaxis(significant, -1, 0)
    sign = jnp.where(w != 0, w, jnp.where(x != 0, x, jnp.where(y != 0, y, z)))
    return quaternion * jnp.where(sign < 0, -1.0, 1.0)[..., None]


def quaternion_slerp(start: ArrayLike, end: ArrayLike, fraction: ArrayLike) -> Array:
    """The rotation at ``fraction`` (...,) of the shorter way from ``start`` to ``end``, at constant angular speed."""
    start, end = jnp.asarray(start), jnp.asarray(end)
    dot = jnp.sum(start * end, axis=-1, keepdims=True)
    end = jnp.where(dot < 0, -end, end)
    # atan2 of the two chords is exact for close rotations, where arccos of the dot product loses half of the digits.
    angle = 2.0 * jnp.arctan2(
        jnp.linalg.norm(end - start, axis=-1, keepdims=True), jnp.linalg.norm(end + start, axis=-1, keepdims=True)
    )
    t = jnp.asarray(fraction, jnp.float32)[..., None]
    close = angle < 1e-4
    sine = jnp.where(close, 1.0, jnp.sin(angle))
    first = jnp.where(close, 1.0 - t, jnp.sin((1.0 - t) * angle) / sine)
    second = jnp.where(close, t, jnp.sin(t * angle) / sine)
    return normalize(first * start + second * end)


def rotation_distance(first: ArrayLike, second: ArrayLike) -> Array:
    """The angle in radians, 0 to pi, of the turn that takes one rotation to the other. (..., 4) x 2 -> (...,)."""
    difference = quaternion_multiply(quaternion_conjugate(first), second)
    return 2.0 * jnp.arctan2(jnp.linalg.norm(difference[..., :3], axis=-1), jnp.abs(difference[..., 3]))
