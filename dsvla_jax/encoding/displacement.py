"""Displacements as poses inside the codec's box, so that the same answer text can say where to go from here.

A displacement is (..., 6): metres, and a rotation vector in radians, both in the base frame: it is added to a position
and multiplied from the left to a rotation.
"""

import dataclasses

import numpy as np
from numpy.typing import ArrayLike

from dsvla_jax.encoding.codec import PoseCodec
from dsvla_jax.geometry.rotations import (
    hamilton_product,
    quaternion_to_rotation_vector,
    rotation_vector_to_quaternion,
)

HALF_RANGE_ANGLE = np.pi / 2
"""Radians that stand for the end of the range of one axis; three ends together stay below a half turn."""
LEAST_RANGE = 1e-6
"""Metres or radians: a component that varies less is constant. Its variation is the rounding of float32, which bins
would blow up to their whole range."""


def is_constant(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """bool (...): whether numbers between `low` and `high` (...) vary by no more than `LEAST_RANGE`."""
    return high - low <= LEAST_RANGE


@dataclasses.dataclass(frozen=True)
class DisplacementScale:
    """The range of each component that the bins cover: `low` to `high`, metres and radians.

    A component that does not vary (by more than `LEAST_RANGE`) is written as the middle and read as `low`.
    """

    low: tuple[float, ...]
    high: tuple[float, ...]

    def __post_init__(self) -> None:
        if len(self.low) != 6 or len(self.high) != 6 or any(a > b for a, b in zip(self.low, self.high, strict=True)):
            raise ValueError(f"DisplacementScale: expected six low <= high, got {self.low} and {self.high}")

    @property
    def varies(self) -> np.ndarray:
        """bool (6,): which components do."""
        return ~is_constant(np.array(self.low), np.array(self.high))

    def to_pose(self, displacement: ArrayLike, codec: PoseCodec) -> np.ndarray:
        """(..., 6) -> float32 (..., 7), inside the codec's box; what lies beyond the range is moved to its end."""
        low, high = np.array(self.low), np.array(self.high)
        span = np.where(self.varies, high - low, 1.0)
        fraction = np.where(self.varies, 2 * (np.asarray(displacement, np.float64) - low) / span - 1, 0.0)
        fraction = np.clip(fraction, -1.0, 1.0)
        centre, half = _box(codec)
        rotation = rotation_vector_to_quaternion(fraction[..., 3:] * HALF_RANGE_ANGLE)
        return np.concatenate([centre + half * fraction[..., :3], rotation], axis=-1).astype(np.float32)

    def from_pose(self, pose: ArrayLike, codec: PoseCodec) -> np.ndarray:
        """The inverse of `to_pose`: float32 (..., 7) -> (..., 6)."""
        pose = np.asarray(pose, np.float64)
        centre, half = _box(codec)
        rotation = quaternion_to_rotation_vector(pose[..., 3:]) / HALF_RANGE_ANGLE
        fraction = np.clip(np.concatenate([(pose[..., :3] - centre) / half, rotation], axis=-1), -1.0, 1.0)
        low, high = np.array(self.low), np.array(self.high)
        return np.where(self.varies, low + (fraction + 1) / 2 * (high - low), low).astype(np.float32)


def displacement(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """float64 (..., 6): what leads from poses (..., 7) to poses (..., 7)."""
    first, last = start[..., 3:].astype(np.float64), end[..., 3:].astype(np.float64)
    inverse = first * np.array([-1.0, -1.0, -1.0, 1.0])
    turned = quaternion_to_rotation_vector(hamilton_product(last, inverse))
    return np.concatenate([end[..., :3] - start[..., :3], turned], axis=-1)


def displace(pose: ArrayLike, displacement: ArrayLike) -> np.ndarray:
    """float32 (..., 7): the pose that a displacement (..., 6) leads to from poses (..., 7)."""
    pose, displacement = np.asarray(pose, np.float64), np.asarray(displacement, np.float64)
    turned = hamilton_product(rotation_vector_to_quaternion(displacement[..., 3:]), pose[..., 3:])
    return np.concatenate([pose[..., :3] + displacement[..., :3], turned], axis=-1).astype(np.float32)


def _box(codec: PoseCodec) -> tuple[np.ndarray, np.ndarray]:
    low, high = np.array(codec.low), np.array(codec.high)
    return (low + high) / 2, (high - low) / 2
