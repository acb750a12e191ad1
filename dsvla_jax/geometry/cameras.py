"""Pinhole cameras in the convention of RLBench and PyRep.

Camera axes: z forward, and, because both focal lengths are negative, x to the image's left and y up. Pixel (u, v) is
column u and row v, and a depth map's entry [v, u] is the planar depth of the ray through exactly (u, v): PyRep
unprojects integer pixel indices, without half a pixel.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from dsvla_jax.types import Array, Camera

# Full float32 products: the default on accelerators is coarser than a pixel.
_HIGHEST = jax.lax.Precision.HIGHEST

# RLBench's front camera: 1.35 m in front of the robot, looking back at it, pitched down by 25 degrees.
_PITCH = np.deg2rad(25.0)
FRONT_WORLD_FROM_CAMERA = np.array(
    [
        [0.0, -np.sin(_PITCH), -np.cos(_PITCH), 1.35],
        [-1.0, 0.0, 0.0, 0.0],
        [0.0, np.cos(_PITCH), -np.sin(_PITCH), 1.58],
        [0.0, 0.0, 0.0, 1.0],
    ],
    np.float32,
)
FRONT_FIELD_OF_VIEW = float(np.deg2rad(40.0))


def make_camera(world_from_camera: ArrayLike, fov_radians: float, height: int, width: int) -> Camera:
    """A camera with square pixels and the optical axis at (width / 2, height / 2).

    Args:
        world_from_camera: (4, 4), camera-to-world.
        fov_radians: the field of view along the longer side of the image, CoppeliaSim's perspective angle.
    """
    focal = -0.5 * max(height, width) / np.tan(0.5 * fov_radians)
    intrinsics = np.array([[focal, 0.0, 0.5 * width], [0.0, focal, 0.5 * height], [0.0, 0.0, 1.0]], np.float32)
    return Camera(
        intrinsics=jnp.asarray(intrinsics),
        world_from_camera=_matrix44(world_from_camera, "world_from_camera"),
    )


def front_camera(size: int) -> Camera:
    """RLBench's front camera with a square image of ``size`` pixels: 40 degrees both ways."""
    return make_camera(jnp.asarray(FRONT_WORLD_FROM_CAMERA), FRONT_FIELD_OF_VIEW, size, size)


def project(points: ArrayLike, camera: Camera) -> tuple[Array, Array]:
    """World points to pixels.

    Args:
        points: float (..., 3), metres, world frame.

    Returns:
        pixels (..., 2) as (u, v), not rounded and not limited to the image; depth (...,), planar, metres. Pixels mean
        nothing where depth <= 0, behind the camera; they are finite there unless the point is in the lens itself.
    """
    rotation, translation = camera.world_from_camera[:3, :3], camera.world_from_camera[:3, 3]
    local = jnp.einsum("...i,ij->...j", jnp.asarray(points) - translation, rotation, precision=_HIGHEST)
    depth = local[..., 2]
    # Far below float noise in any scene, so it changes nothing but keeps 0 / 0 out.
    safe = jnp.where(jnp.abs(depth) < 1e-9, 1e-9, depth)[..., None]
    homogeneous = jnp.concatenate([local[..., :2] / safe, jnp.ones_like(safe)], axis=-1)
    pixels = jnp.einsum("ij,...j->...i", camera.intrinsics[:2], homogeneous, precision=_HIGHEST)
    return pixels, depth


def unproject(depth: ArrayLike, camera: Camera) -> Array:
    """A depth map to the world points of its pixels.

    Args:
        depth: float (H, W), planar, metres.

    Returns:
        float32 (H, W, 3), metres, world frame; where depth is 0 that is the camera's own position.
    """
    depth = jnp.asarray(depth)
    height, width = depth.shape
    u = jnp.arange(width, dtype=jnp.float32)[None, :]
    v = jnp.arange(height, dtype=jnp.float32)[:, None]
    return unproject_pixels(u, v, depth, camera)


def unproject_pixels(u: Array, v: Array, depth: Array, camera: Camera) -> Array:
    """Pixels (u, v) with planar depth, broadcast together to some shape (...), to world points (..., 3)."""
    k = camera.intrinsics
    y = (v - k[1, 2]) / k[1, 1]
    x = (u - k[0, 2] - k[0, 1] * y) / k[0, 0]
    shape = jnp.broadcast_shapes(x.shape, y.shape, depth.shape)
    rays = jnp.stack([jnp.broadcast_to(x, shape), jnp.broadcast_to(y, shape), jnp.ones(shape, jnp.float32)], axis=-1)
    local = rays * depth[..., None]
    rotation, translation = camera.world_from_camera[:3, :3], camera.world_from_camera[:3, 3]
    return jnp.einsum("ij,...j->...i", rotation, local, precision=_HIGHEST) + translation


def _matrix44(matrix: ArrayLike, name: str) -> Array:
    if jnp.shape(matrix) != (4, 4):
        raise ValueError(f"{name}: expected a (4, 4) camera-to-world matrix, got shape {jnp.shape(matrix)}")
    return jnp.asarray(matrix, jnp.float32)
