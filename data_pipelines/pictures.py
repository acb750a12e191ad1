"""Crops that take the camera along, and quick photometric variation, on uint8 pictures.

A box is (top, left, height, width) in whole pixels. There is no mirror: a mirrored picture of a robot and of the words
left and right is not true, whatever its camera says.
"""

import cv2
import numpy as np

Box = tuple[int, int, int, int]

# Shares of red, green and blue in grey (ITU-R BT.601).
GREY = np.array([0.299, 0.587, 0.114])


def random_box(rng: np.random.Generator, height: int, width: int, smallest: float) -> Box:
    """A box with the picture's own proportions, of `smallest` to all of its sides, anywhere inside."""
    part = rng.uniform(smallest, 1.0)
    rows, columns = max(min(2, height), round(height * part)), max(min(2, width), round(width * part))
    return int(rng.integers(0, height - rows + 1)), int(rng.integers(0, width - columns + 1)), rows, columns


def crop_resize(picture: np.ndarray, box: Box, size: tuple[int, int], nearest: bool = False) -> np.ndarray:
    """The box of (H, W) or (H, W, 3) in a size of (height, width). nearest: for depth, which must not be blended."""
    top, left, rows, columns = box
    part = picture[top : top + rows, left : left + columns]
    height, width = size
    if (rows, columns) == size:
        return np.ascontiguousarray(part)
    shrinks = rows > 1.5 * height or columns > 1.5 * width
    mode = cv2.INTER_NEAREST_EXACT if nearest else cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    return cv2.resize(part, (width, height), interpolation=mode)


def crop_intrinsics(intrinsics: np.ndarray, box: Box, size: tuple[int, int]) -> np.ndarray:
    """float32 (3, 3) of the picture that `crop_resize` makes; pixel (0, 0) is the middle of the first pixel."""
    top, left, rows, columns = box
    down, across = size[0] / rows, size[1] / columns
    moved = np.array(
        [
            [across, 0, across * (0.5 - left) - 0.5],
            [0, down, down * (0.5 - top) - 0.5],
            [0, 0, 1],
        ]
    )
    return (moved @ intrinsics.astype(np.float64)).astype(np.float32)


def vary_light(
    picture: np.ndarray, rng: np.random.Generator, strength: float, out: np.ndarray | None = None
) -> np.ndarray:
    """uint8 (H, W, 3) with brightness, contrast and saturation varied by up to ±strength; into `out` if given."""
    brightness, contrast, saturation = 1 + rng.uniform(-strength, strength, 3)
    # All three are linear: (s v + (1 - s) grey) b, moved away from or towards the mean grey by the contrast.
    gain, mean = brightness * contrast, np.dot(GREY, cv2.mean(picture)[:3]) * brightness
    colours = gain * (saturation * np.eye(3) + (1 - saturation) * GREY)
    return cv2.transform(picture, np.column_stack([colours, np.full(3, mean * (1 - contrast))]), out)
