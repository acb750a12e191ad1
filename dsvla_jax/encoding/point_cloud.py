"""A depth map to the points of the workspace that are seen in it."""

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Bool, Float

from dsvla_jax.encoding.config import EncodingConfig
from dsvla_jax.geometry.cameras import unproject_pixels
from dsvla_jax.types import Array, Camera, Picture


def cloud_from_depth(
    depth: ArrayLike,
    camera: Camera,
    workspace_low: tuple[float, float, float],
    workspace_high: tuple[float, float, float],
    stride: int = 1,
) -> tuple[Array, Array]:
    """Every ``stride``-th pixel of every ``stride``-th row as a world point, row by row.

    Args:
        depth: float (H, W), planar, metres; 0, negative or non-finite where there is no reading.
        workspace_low, workspace_high: corners of the box to keep, metres, world frame.

    Returns:
        points: float32 (P0, 3), P0 = ceil(H / stride) * ceil(W / stride), metres, world frame, always finite.
        valid: bool (P0,), False without a reading or outside the box.
    """
    depth = jnp.asarray(depth, jnp.float32)
    if depth.ndim != 2:
        raise ValueError(f"depth: expected one map (H, W), got shape {depth.shape}; use vmap for a batch")
    v = jnp.arange(0, depth.shape[0], stride)
    u = jnp.arange(0, depth.shape[1], stride)
    depth = depth[::stride, ::stride]
    measured = jnp.isfinite(depth) & (depth > 0)
    depth = jnp.where(measured, depth, 0.0)
    points = unproject_pixels(u[None, :].astype(jnp.float32), v[:, None].astype(jnp.float32), depth, camera)
    low, high = jnp.array(workspace_low, jnp.float32), jnp.array(workspace_high, jnp.float32)
    inside = jnp.all((points >= low) & (points <= high), axis=-1)
    return points.reshape(-1, 3), (measured & inside).reshape(-1)


def joint_cloud(pictures: Picture[Array], config: EncodingConfig) -> tuple[Float[Array, "b q 3"], Bool[Array, "b q"]]:
    """Every candidate point of a batch of pictures (B, C, H, W), those of one camera after those of the other.

    Returns the points (metres, world frame) and whether each is a reading inside the workspace; see `cloud_from_depth`.
    """
    batch, cameras, height, width = pictures.depth.shape
    config.require_points(height, width, cameras)
    cloud = jax.vmap(
        lambda depth, camera: cloud_from_depth(
            depth, camera, config.workspace_low, config.workspace_high, config.stride
        )
    )
    each = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), (pictures.depth, pictures.camera))
    points, valid = cloud(*each)
    return points.reshape(batch, -1, 3), valid.reshape(batch, -1)
