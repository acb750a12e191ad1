"""2D-to-3D positional alignment: which image patch's positional embedding a 3D token carries."""

from typing import Literal

import jax.numpy as jnp
from jax.typing import ArrayLike

from dsvla_jax.geometry.cameras import project
from dsvla_jax.types import Array, Camera

AlignmentMode = Literal["aligned", "index_order"]
ALIGNMENT_MODES: tuple[AlignmentMode, ...] = ("aligned", "index_order")


def align_to_patches(
    centers: ArrayLike, camera: Camera, image_height: int, image_width: int, grid: int, mode: AlignmentMode
) -> Array:
    """The patch of each 3D token.

    aligned      the patch its centre is seen in. Centres outside the image take the nearest patch of its border,
                 those behind the camera a patch of the border too.
    index_order  token i takes patch i: the paper's ablation with the 2D embeddings in their original order.

    Args:
        centers: float (G, 3), metres, world frame.
        camera: of the image that ``image_height`` and ``image_width`` describe, before any resizing for the network.
        grid: patches along a side; the network sees the whole image, resized to a square.

    Returns:
        int32 (G,), row-major patch indices below grid * grid.
    """
    centers = jnp.asarray(centers)
    if mode == "index_order":
        if centers.shape[0] > grid * grid:
            raise ValueError(
                f"alignment index_order: expected at most {grid * grid} 3D tokens, one a patch, got {centers.shape[0]}"
            )
        return jnp.arange(centers.shape[0], dtype=jnp.int32)
    if mode != "aligned":
        raise ValueError(f"alignment mode: expected one of {', '.join(ALIGNMENT_MODES)}, got {mode!r}")
    pixels, _ = project(centers, camera)
    # Points were unprojected from integer pixel indices. Half a pixel moves them to pixel centres, so that float noise
    # cannot push a point over a patch's edge, whatever the resizing.
    scale = jnp.array([grid / image_width, grid / image_height], jnp.float32)
    cell = jnp.clip(jnp.floor((pixels + 0.5) * scale), 0, grid - 1).astype(jnp.int32)
    return cell[..., 1] * grid + cell[..., 0]
