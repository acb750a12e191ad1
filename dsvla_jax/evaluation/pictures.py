"""Pictures of episodes: film strips, and marks where a policy means to go."""

from collections.abc import Sequence

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from dsvla_jax.geometry.cameras import project
from dsvla_jax.types import Camera

MAX_STRIP_FRAMES = 10
_GAP = 2  # pixels between the frames of a strip
_ARM_COLOURS = ((255, 0, 200), (0, 220, 255))  # RGB, the left arm first; no task has an object of these colours


def mark_targets(frame: np.ndarray, positions: ArrayLike, camera: Camera) -> np.ndarray:
    """A copy of the frame with a ring where each arm's target is: magenta the left or only arm, cyan the right one.

    frame: uint8 (H, W, 3), RGB. positions: float (A, 3), metres, world frame. A target outside the picture is a dot at
    the nearest border; one behind the camera is left out.
    """
    picture = np.ascontiguousarray(frame).copy()
    height, width = picture.shape[:2]
    pixels, depth = project(jnp.asarray(positions, jnp.float32), camera)
    radius = max(3.0, height / 24)
    fraction = 4  # sub-pixel bits of cv2's fixed-point coordinates
    for (u, v), z, colour in zip(np.asarray(pixels), np.asarray(depth), _ARM_COLOURS, strict=False):
        if z <= 0:
            continue
        inside = 0 <= u <= width - 1 and 0 <= v <= height - 1
        size = radius if inside else 0.5 * radius
        place = np.clip([u, v], size, [width - 1 - size, height - 1 - size]) if not inside else np.array([u, v])
        centre = tuple(round(float(c) * 2**fraction) for c in place)
        for shade, thickness in (((0, 0, 0), 2), (colour, 1)) if inside else (((0, 0, 0), 2), (colour, -1)):
            cv2.circle(picture, centre, int(size * 2**fraction), shade, thickness, cv2.LINE_AA, fraction)
        if inside:
            cv2.circle(picture, centre, int(0.15 * radius * 2**fraction), colour, -1, cv2.LINE_AA, fraction)
    return picture


def mark_view(rgb: np.ndarray, positions: ArrayLike | None, cameras: Camera) -> np.ndarray:
    """The pictures of C cameras one below the other, uint8 (C H, W, 3), with `mark_targets` in each.

    rgb: uint8 (C, H, W, 3). positions: None for no targets. cameras: stacked, C of them.
    """
    if positions is None:
        return np.concatenate(list(rgb))
    one = [jax.tree.map(lambda x, c=c: x[c], cameras) for c in range(len(rgb))]
    return np.concatenate([mark_targets(frame, positions, camera) for frame, camera in zip(rgb, one, strict=True)])


def film_strip(frames: Sequence[np.ndarray], max_frames: int = MAX_STRIP_FRAMES) -> np.ndarray:
    """Frames uint8 (H, W, 3) side by side; of more than ``max_frames`` an even choice with the first and the last."""
    if not len(frames):
        raise ValueError("a film strip needs at least one frame")
    chosen = np.unique(np.linspace(0, len(frames) - 1, min(len(frames), max_frames)).round().astype(int))
    gap = np.full((frames[0].shape[0], _GAP, 3), 255, np.uint8)
    pieces = [piece for index in chosen for piece in (frames[index], gap)]
    return np.concatenate(pieces[:-1], axis=1)
