"""Farthest point sampling: a subset that covers a cloud evenly.

Sampling n points and then m < n of those gives the first m of the n, so one run orders a cloud for all later levels.
"""

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike

from dsvla_jax.types import Array


def farthest_point_sample(points: ArrayLike, valid: ArrayLike | None, count: int) -> Array:
    """Greedy choice: the first valid point, then again and again the one farthest from all chosen so far.

    Squared distances in float32; of equally far points the first. Invalid points are never chosen; once every valid
    position is taken the first valid point is repeated (and index 0 where a cloud has no valid point at all).

    Args:
        points: float (B, P, 3). valid: bool (B, P), or None when all are.

    Returns:
        int32 (B, count), indices into P.
    """
    points = jnp.asarray(points, jnp.float32)
    if points.ndim != 3 or points.shape[-1] != 3:
        raise ValueError(f"points: expected a batch of clouds (B, P, 3), got shape {points.shape}")
    batch, size, _ = points.shape
    # Separate coordinates, the whole batch in each step, and max followed by min instead of argmax: on a CPU, XLA
    # vectorises these and not argmax, which makes this an order of magnitude faster than vmap of the usual loop.
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    index = jnp.arange(size, dtype=jnp.int32)

    def farthest(distance: Array) -> Array:
        best = jnp.max(distance, axis=1, keepdims=True)
        return jnp.min(jnp.where(distance == best, index, size - 1), axis=1)

    def step(i: int, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        distance, chosen = carry
        last = jax.lax.dynamic_slice_in_dim(chosen, i - 1, 1, axis=1)
        dx, dy, dz = (a - jnp.take_along_axis(a, last, axis=1) for a in (x, y, z))
        distance = jnp.minimum(distance, dx * dx + dy * dy + dz * dz)
        return distance, jax.lax.dynamic_update_slice_in_dim(chosen, farthest(distance)[:, None], i, axis=1)

    # An invalid point's distance starts, and so stays, below every squared distance.
    distance = jnp.full((batch, size), jnp.inf, jnp.float32)
    if valid is not None:
        distance = jnp.where(jnp.asarray(valid), distance, -1.0)
    chosen = jnp.zeros((batch, count), jnp.int32).at[:, 0].set(farthest(distance))
    return jax.lax.fori_loop(1, count, step, (distance, chosen))[1]
