"""Exact k nearest neighbours in a point cloud."""

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike

from dsvla_jax.types import Array

# Bounds memory, and a block's distances stay in the cache of a CPU core.
_QUERIES_AT_ONCE = 32


def k_nearest_neighbours(queries: ArrayLike, points: ArrayLike, k: int) -> Array:
    """The k points closest to each query, nearest first; of equally near points the first.

    Squared distances in float32, from coordinate differences. A query that is itself a point is its own neighbour.

    Args:
        queries: float (G, 3). points: float (P, 3).

    Returns:
        int32 (G, k), indices into P.
    """
    queries, points = jnp.asarray(queries, jnp.float32), jnp.asarray(points, jnp.float32)
    count, size = queries.shape[0], points.shape[0]
    if not 1 <= k <= size:
        raise ValueError(f"k: expected 1 to {size}, the number of points, got {k}")

    # Of equal values top_k takes the one with the lower index first.
    def nearest(block: Array) -> Array:
        dx, dy, dz = (block[:, axis, None] - points[None, :, axis] for axis in range(3))
        return jax.lax.top_k(-(dx * dx + dy * dy + dz * dz), k)[1]

    blocks = -(-count // _QUERIES_AT_ONCE)
    padded = jnp.pad(queries, ((0, blocks * _QUERIES_AT_ONCE - count), (0, 0)))
    found = jax.lax.map(nearest, padded.reshape(blocks, _QUERIES_AT_ONCE, 3))
    return found.reshape(-1, k)[:count]
