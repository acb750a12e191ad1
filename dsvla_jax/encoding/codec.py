"""Keyframes as small integers: the 200-bin codec of the action text.

Positions are counted in steps of a 200th of the workspace box, so with the default 2 m box in centimetres of the world
frame. Quaternion components are counted in hundredths. The gripper is 0 or 1.
"""

import dataclasses
import functools
from types import ModuleType

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from dsvla_jax.ranges import Range, at_least, check_fields, require, require_box
from dsvla_jax.types import Action, Array

QUATERNION_STEP = 0.01
VALUES_PER_ARM = 8
QUATERNION_VALUES = slice(3, 7)  # of them


@dataclasses.dataclass(frozen=True)
class PoseCodec:
    """Integers for poses inside a box, and back.

    NumPy arrays in give NumPy arrays out (the data loader's path); anything else goes through jax.numpy and can be
    jitted and vmapped.
    """

    low: tuple[float, float, float] = (-1.0, -1.0, 0.0)
    """Lower corner of the box, metres, world frame. Positions outside are moved to its surface."""
    high: tuple[float, float, float] = (1.0, 1.0, 2.0)
    """Upper corner of the box, metres, world frame."""
    bins: int = 200
    """Intervals along each side of the box (paper: 200). A position is round(value / step) with step = (high - low) /
    bins."""

    def __post_init__(self) -> None:
        metres = Range(-1000, 1000)
        check_fields(self, "encoding.codec", low=metres, high=metres, bins=at_least(1))
        require_box("encoding.codec.low", self.low, "high", self.high)
        require(bool((self.step > 1e-6).all()), "encoding.codec.bins", "steps of more than 1e-6 metres", self.step)

    # Cached: the data loader asks for them several times a sample.
    @functools.cached_property
    def step(self) -> np.ndarray:
        """float32 (3,): metres in one step of each axis, also the largest gap between neighbouring positions."""
        return ((np.array(self.high, np.float64) - np.array(self.low, np.float64)) / self.bins).astype(np.float32)

    @functools.cached_property
    def _ends(self) -> tuple[np.ndarray, np.ndarray]:
        """float32 (3,) each: the integers of the box's corners."""
        low, high = (np.round(np.array(corner) / self.step) for corner in (self.low, self.high))
        return low.astype(np.float32), high.astype(np.float32)

    def encode_position(self, position: ArrayLike) -> Array:
        """Positions (..., 3) in metres -> int32 (..., 3)."""
        xp = _namespace(position)
        steps = xp.round(xp.asarray(position, np.float32) / self.step)
        return xp.clip(steps, *self._ends).astype(np.int32)

    def encode(self, action: Action | ArrayLike, gripper_open: ArrayLike | None = None) -> Array:
        """An Action, or poses (..., 7) with gripper_open (...,), -> int32 (..., 8): x y z qx qy qz qw gripper.

        Of q and -q the one is written whose first non-zero *integer* in the order w, x, y, z is positive. Choosing
        after rounding treats a real part below half a step (0.005) as zero: a gripper that points straight down has
        w = 0, and without this the noise of its w would flip the sign of the whole text.
        """
        if isinstance(action, Action):
            pose, gripper_open = action.pose, action.gripper_open
        elif gripper_open is None:
            raise ValueError(
                "PoseCodec.encode: expected an Action, or a pose and gripper_open; gripper_open is missing"
            )
        else:
            pose = action
        xp = _namespace(pose, gripper_open)
        pose = xp.asarray(pose, np.float32)
        quaternion = pose[..., 3:7]
        length = xp.maximum(xp.sqrt(xp.sum(quaternion * quaternion, axis=-1, keepdims=True)), np.float32(1e-12))
        rotation = xp.round(quaternion / length / np.float32(QUATERNION_STEP)).astype(np.int32)
        rotation = rotation * _canonical_sign(rotation, xp)[..., None]
        gripper = (xp.asarray(gripper_open, np.float32) > 0.5).astype(np.int32)
        return xp.concatenate([self.encode_position(pose[..., :3]), rotation, gripper[..., None]], axis=-1)

    def decode(self, integers: ArrayLike) -> Action:
        """int32 (..., 8) -> Action with pose (..., 7) and gripper_open (...,), float32, quaternions of unit length.

        Encoding the result gives the same position and gripper; a quaternion integer may differ by one, because
        rounded quaternions are not quite of unit length. Four zeros name no rotation and stay four zeros.
        """
        xp = _namespace(integers)
        values = xp.asarray(integers)
        position = values[..., :3].astype(np.float32) * self.step
        rotation = values[..., 3:7].astype(np.float32)
        length = xp.sqrt(xp.sum(rotation * rotation, axis=-1, keepdims=True))
        rotation = rotation / xp.maximum(length, np.float32(1.0))
        return Action(
            pose=xp.concatenate([position, rotation], axis=-1), gripper_open=values[..., 7].astype(np.float32)
        )


def _canonical_sign(rotation: Array, xp: ModuleType) -> Array:
    sign = np.int32(1)
    for component in (2, 1, 0, 3):  # the last one written wins: w before x before y before z
        value = rotation[..., component]
        sign = xp.where(value != 0, xp.sign(value), sign)
    return sign


def _namespace(*arrays: object) -> ModuleType:
    plain = (np.ndarray, np.generic, float, int, list, tuple)
    return np if all(isinstance(array, plain) for array in arrays) else jnp
