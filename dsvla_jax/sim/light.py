"""The sun of the simulated scenes: where its light comes from, for the renderer and for the state of an episode."""

import numpy as np

LIGHT_DIRECTION = (-0.35, 0.25, -1.0)


def light_direction() -> np.ndarray:
    """Returns the usual direction of travel of the light: float32 (3,), unit length, world frame."""
    direction = np.asarray(LIGHT_DIRECTION)
    return (direction / np.linalg.norm(direction)).astype(np.float32)
