"""The keypoint constraint in time: which object point is given to an arm.

An arm has K keypoints in the order the instruction names them. The active one is the first it has not yet come within
5 cm of; it never goes back, and the last one stays active for good. Arms with fewer than K keypoints repeat their last.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from dsvla_jax.types import Array, library_of

REACHED_RADIUS = 0.05


def active_keypoint(latched_count: ArrayLike, keypoints: ArrayLike, count: ArrayLike | None = None) -> Array:
    """The keypoint an arm is heading for.

    Args:
        latched_count: int (), how many keypoints it has reached.
        keypoints: float (K, 3), metres, world frame.
        count: int (), how many of the K are real; all when None.

    Returns:
        float (3,). A NumPy array if ``keypoints`` is one.
    """
    xp = library_of(keypoints)
    points = xp.asarray(keypoints)
    last = (points.shape[0] if count is None else xp.asarray(count)) - 1
    return points[xp.clip(xp.asarray(latched_count), 0, last)]


def advance_latch(
    latched: ArrayLike, end_effector: ArrayLike, keypoints: ArrayLike, radius: float = REACHED_RADIUS
) -> Array:
    """Counts the keypoints reached, given where the arms are now.

    Only the active keypoint can be reached, so they are reached in order; one look may pass several when they lie
    within ``radius`` of the arm together.

    Args:
        latched: int32 (A,), the count so far, 0 to K.
        end_effector: float (A, 3). keypoints: float (A, K, 3). Metres, world frame.

    Returns:
        int32 (A,), at least ``latched``. A NumPy array if ``keypoints`` is one.
    """
    xp = library_of(keypoints)
    points = xp.asarray(keypoints)
    distance = xp.linalg.norm(points - xp.asarray(end_effector)[:, None, :], axis=-1)
    reached = (distance < radius) | (xp.arange(points.shape[1]) < xp.asarray(latched)[:, None])
    return xp.sum(xp.cumprod(reached.astype(np.int32), axis=1), axis=1, dtype=np.int32)


def replay_latch(end_effector: ArrayLike, keypoints: ArrayLike) -> Array:
    """The keypoint each arm is heading for in every frame: positions (F, A, 3), keypoints (A, K, 3) -> (F, A, 3)."""
    keypoints = jnp.asarray(keypoints)

    def look(latched: Array, position: Array) -> tuple[Array, Array]:
        latched = advance_latch(latched, position, keypoints)
        return latched, jax.vmap(active_keypoint)(latched, keypoints)

    return jax.lax.scan(look, jnp.zeros(keypoints.shape[0], jnp.int32), jnp.asarray(end_effector))[1]
