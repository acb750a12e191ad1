"""2D-to-3D positional alignment: which image patch's positional embedding a 3D token carries."""

from typing import Literal

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike

from dsvla_jax.geometry.cameras import project
from dsvla_jax.types import Array, Camera

AlignmentMode = Literal["aligned", "index_order"]
ALIGNMENT_MODES: tuple[AlignmentMode, ...] = ("aligned", "index_order")


def align_to_patches(
    centers: ArrayLike,
    seen_by: ArrayLike,
    cameras: Camera,
    image_height: int,
    image_width: int,
    grid: int,
    mode: AlignmentMode,
) -> Array:
    """The patch of each 3D token.

    aligned      the patch that the token's own camera sees its centre in. Centres outside the image take the nearest
                 patch of its border, those behind the camera a patch of the border too.
    index_order  token i takes patch i: the paper's ablation with the 2D embeddings in their original order.

    Args:
        centers: float (G, 3), metres, world frame.
        seen_by: int (G,), which of the C cameras each centre comes from.
        cameras: stacked, C of them, of images that ``image_height`` and ``image_width`` describe, before any resizing
            for the network.
        grid: patches along a side; the network sees the whole image, resized to a square.

    Returns:
        int32 (G,), camera * grid * grid + row-major patch index.
    """
    centers, seen_by = jnp.asarray(centers), jnp.asarray(seen_by)
    if mode == "index_order":
        patches = len(cameras.intrinsics) * grid * grid
        if centers.shape[0] > patches:
            raise ValueError(
                f"alignment index_order: expected at most {patches} 3D tokens, one a patch, got {centers.shape[0]}"
            )
        return jnp.arange(centers.shape[0], dtype=jnp.int32)
    if mode != "aligned":
        raise ValueError(f"alignment mode: expected one of {', '.join(ALIGNMENT_MODES)}, got {mode!r}")
    # Every camera projects every centre, and each centre keeps one projection: cheaper than a camera for each centre.
    everywhere, _ = jax.vmap(lambda camera: project(centers, camera))(cameras)
    pixels = everywhere[seen_by, jnp.arange(len(centers))]
    # Points were unprojected from integer pixel indices. Half a pixel moves them to pixel centres, so that float noise
    # cannot push a point over a patch's edge, whatever the resizing.
    scale = jnp.array([grid / image_width, grid / image_height], jnp.float32)
    cell = jnp.clip(jnp.floor((pixels + 0.5) * scale), 0, grid - 1).astype(jnp.int32)
    return seen_by.astype(jnp.int32) * grid * grid + cell[..., 1] * grid + cell[..., 0]
