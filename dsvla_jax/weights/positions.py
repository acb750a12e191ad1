"""Positional embeddings of a vision tower, carried over to another number of patches."""

import numpy as np

# The sharpness of the cubic kernel (Keys 1981, a) that PyTorch's "bicubic" has, and with it `transformers`' CLIP.
SHARPNESS = -0.75


def resample_positions(positions: np.ndarray, grid: int) -> np.ndarray:
    """(1 + N, D), row-major over a square grid behind the class token -> float32 (1 + grid * grid, D).

    Bicubic, patch centres aligned, edges repeated, no low-pass filter: as CLIPVisionModel interpolates them itself.
    """
    old = round((len(positions) - 1) ** 0.5)
    if old * old != len(positions) - 1:
        raise ValueError(f"positions: expected 1 + a square number of rows, got {positions.shape}")
    positions = np.asarray(positions, np.float32)
    if old == grid:
        return positions
    matrix = _cubic_matrix(old, grid).astype(np.float32)
    patches = positions[1:].reshape(old, old, -1)
    patches = np.einsum("yi,xj,ijd->yxd", matrix, matrix, patches, optimize=True)
    return np.concatenate([positions[:1], patches.reshape(grid * grid, -1)])


def _cubic_matrix(old: int, new: int) -> np.ndarray:
    """float64 (new, old): row i weighs the old samples around the centre of new sample i. Rows sum to 1."""
    centres = (np.arange(new) + 0.5) * old / new - 0.5
    before = np.floor(centres).astype(int)
    matrix = np.zeros((new, old))
    for tap in (-1, 0, 1, 2):
        x = np.abs(centres - (before + tap))
        a = SHARPNESS
        near = ((a + 2) * x - (a + 3)) * x * x + 1
        far = ((a * x - 5 * a) * x + 8 * a) * x - 4 * a
        np.add.at(matrix, (np.arange(new), np.clip(before + tap, 0, old - 1)), np.where(x <= 1, near, far))
    return matrix
