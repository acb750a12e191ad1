"""What every dataset is brought to: `Motion`, and the small vocabulary in which the registry says how.

Standard: positions in metres, rotations as unit quaternions xyzw or rotation vectors in radians, grippers 1 for open
and 0 for closed, two arms left first. A displacement is what is added to a position and multiplied from the left to a
rotation (``frame="base"``), or the same seen from the tool (``frame="tool"``).

Axes: T steps of an episode, A arms, J joints.
"""

import dataclasses
from collections.abc import Callable
from typing import Literal, NoReturn

import numpy as np
from scipy.spatial.transform import Rotation

from data_pipelines.rlds.features import RldsEpisode
from dsvla_jax.errors import DataError
from dsvla_jax.observation_checks import QUATERNION_TOLERANCE

RotationKind = Literal["rpy", "ypr", "zxy", "xyzw", "wxyz", "rotvec", "matrix", "yaw", "none"]
Column = Callable[[RldsEpisode], np.ndarray]
"""(T, n) of an episode."""

FRANKA_WIDTH = 0.08
"""Metres between the fingers of an open Franka hand."""


@dataclasses.dataclass(frozen=True)
class Motion:
    """One episode as the policy sees it, without its pictures. float32.

    instruction: empty where the episode has none. pose: (T, A, 7), or None where the data do not tell it.
    gripper_open: (T, A), as measured, or else as last commanded.
    action: (T, A, 6), commanded displacement of each step, translation and rotation vector; or None.
    gripper_command: (T, A). joints: (T, A, J) for datasets that tell joints only, else None.
    """

    instruction: str
    pose: np.ndarray | None
    gripper_open: np.ndarray
    action: np.ndarray | None
    gripper_command: np.ndarray
    joints: np.ndarray | None = None

    @property
    def num_steps(self) -> int:
        return len(self.gripper_command)

    @property
    def num_arms(self) -> int:
        return self.gripper_command.shape[1]


@dataclasses.dataclass(frozen=True)
class Arm:
    """Where one arm's motion stands in an episode.

    pose: (T, 7). action: (T, 6). gripper: (T,), commanded openness. gripper_state: (T,), measured openness.
    joints: (T, J).
    """

    gripper: Column
    pose: Column | None = None
    action: Column | None = None
    gripper_state: Column | None = None
    joints: Column | None = None


def read(path: str, start: int | None = None, stop: int | None = None) -> Column:
    """Columns start to stop of a feature of the steps, float64 (T, n).

    Raises DataError where the feature has fewer columns, or one is not finite.
    """

    def column(episode: RldsEpisode) -> np.ndarray:
        values = episode.column(f"steps/{path}").astype(np.float64)
        values = values.reshape(len(values), -1)
        if stop is not None and values.shape[1] < stop:
            _refuse_width(f"at least {stop}", values, episode.where, f"steps/{path}")
        values = values[:, start:stop]
        # Here and not at the end: what is made of a column may not show that a number was missing.
        require_finite(values, episode.where, f"steps/{path}")
        return values

    return column


def require_finite(values: np.ndarray, where: str, name: str) -> None:
    """Raises DataError naming the first step of values (T, ...) that has a NaN or an infinity."""
    if np.all(np.isfinite(values)):
        return
    step = int(np.argwhere(~np.isfinite(values))[0, 0])
    got = f"{int(np.sum(~np.isfinite(values)))} NaN or infinite, the first at step {step}"
    raise DataError(where, name, "finite numbers", got, "leave the episode out with --skip-bad")


def _refuse_width(expected: str, values: np.ndarray, where: str, name: str) -> NoReturn:
    fix = "is this the version of the dataset that the registry describes?"
    raise DataError(where, name, f"{expected} columns", str(values.shape[1]), fix)


def join(*columns: Column) -> Column:
    """Columns side by side."""
    return lambda episode: np.concatenate([column(episode) for column in columns], axis=1)


def pose(column: Column, rotation: RotationKind, scale: float = 1.0, turn: float = 1.0) -> Column:
    """Position (3, or without a rotation fewer: the rest is zero) and then rotation as (T, 7).

    scale: metres a unit. turn: radians a unit.
    "matrix" takes a flattened 4 x 4 pose, by rows or by columns: whichever leaves 0 0 0 1 at the end.
    """

    def column_of(episode: RldsEpisode) -> np.ndarray:
        values = column(episode)
        _require_width(values, rotation, episode.where, "pose")
        if rotation == "matrix":
            matrix = _pose_matrix(values.reshape(-1, 4, 4), episode)
            position, turned = matrix[:, :3, 3], Rotation.from_matrix(matrix[:, :3, :3])
        else:
            size = _ROTATION_SIZE[rotation]
            position = values[:, : values.shape[1] - size]
            turned = as_rotation(values[:, position.shape[1] :], rotation, turn, episode.where)
        filled = np.zeros((len(values), 3))
        filled[:, : position.shape[1]] = position * scale
        return np.concatenate([filled, turned.as_quat(canonical=True)], axis=1)

    return column_of


def delta(column: Column, rotation: RotationKind, scale: float = 1.0, turn: float = 1.0) -> Column:
    """Translation (3, or without a rotation fewer) and then rotation of a step as (T, 6).

    scale, turn: metres and radians a unit.
    """

    def column_of(episode: RldsEpisode) -> np.ndarray:
        values = column(episode)
        _require_width(values, rotation, episode.where, "action")
        size = _ROTATION_SIZE[rotation]
        moved = np.zeros((len(values), 6))
        moved[:, : values.shape[1] - size] = values[:, : values.shape[1] - size] * scale
        turns = values[:, values.shape[1] - size :]
        if rotation == "xyzw":
            # A step without a motion may be written as four zeros.
            turns = np.where(np.abs(turns).sum(1, keepdims=True) > 0, turns, [0.0, 0.0, 0.0, 1.0])
        moved[:, 3:] = as_rotation(turns, rotation, turn, episode.where).as_rotvec()
        return moved

    return column_of


def in_base(action: Column, pose: Column, translation: bool = True) -> Column:
    """(T, 6): displacements in the tool's frame (or, with `translation` false, their rotation alone) in the base's."""

    def column_of(episode: RldsEpisode) -> np.ndarray:
        moved, tool = action(episode), Rotation.from_quat(pose(episode)[:, 3:])
        shift = tool.apply(moved[:, :3]) if translation else moved[:, :3]
        return np.concatenate([shift, tool.apply(moved[:, 3:])], axis=1)

    return column_of


def openness(column: Column, closed: float, opened: float) -> Column:
    """(T,), the reading mapped linearly so that `closed` gives 0 and `opened` gives 1, clipped to that."""
    return lambda episode: np.clip((column(episode)[:, 0] - closed) / (opened - closed), 0.0, 1.0)


def constant(value: float) -> Column:
    """(T,): a gripper that never moves, or is not told."""
    return lambda episode: np.full(episode.num_steps, value)


def relative_closing(column: Column) -> Column:
    """(T,): commands to close (> 0.1), open (< -0.1) or stay; before the first one, the state that it undoes."""

    def column_of(episode: RldsEpisode) -> np.ndarray:
        values = column(episode)[:, 0]
        command = np.where(values > 0.1, 0.0, np.where(values < -0.1, 1.0, np.nan))
        told = np.flatnonzero(~np.isnan(command))
        if not len(told):
            return np.ones(len(values))
        last = np.maximum.accumulate(np.where(np.isnan(command), -1, np.arange(len(values))))
        return np.where(last < 0, 1.0 - command[told[0]], command[np.maximum(last, 0)])

    return column_of


def settled(column: Column) -> Column:
    """(T,): a continuous opening as 0 or 1, a half-way reading counting as the end that the motion reaches.

    Where the episode ends half-way, the readings since the last end are all the last one, as in octo and openvla.
    """

    def column_of(episode: RldsEpisode) -> np.ndarray:
        values = column(episode)[:, 0]
        result = np.where(values > 0.95, 1.0, np.where(values < 0.05, 0.0, np.nan))
        following = float(values[-1]) if len(values) else 0.0
        for place in range(len(values) - 1, -1, -1):
            following = following if np.isnan(result[place]) else float(result[place])
            result[place] = following
        return result

    return column_of


def following(column: Column) -> Column:
    """(T,): the command that a measured opening shows one step later."""

    def column_of(episode: RldsEpisode) -> np.ndarray:
        values = column(episode)
        return np.concatenate([values[1:], values[-1:]])

    return column_of


def preceding(column: Column) -> Column:
    """(T, n): what the step before told; the first step tells its own."""

    def column_of(episode: RldsEpisode) -> np.ndarray:
        values = column(episode)
        return np.concatenate([values[:1], values[:-1]])

    return column_of


def as_rotation(values: np.ndarray, kind: RotationKind, turn: float, where: str) -> Rotation:
    """(T, size of the kind) as rotations. rpy: about fixed x, y, z. ypr: yaw, pitch, roll. zxy: about fixed z, x, y."""
    match kind:
        case "xyzw" | "wxyz":
            _require_unit(values, where)
            return Rotation.from_quat(values if kind == "xyzw" else np.roll(values, -1, axis=1))
        case "rpy":
            return Rotation.from_euler("xyz", values * turn)
        case "ypr":
            return Rotation.from_euler("ZYX", values * turn)
        case "zxy":
            return Rotation.from_euler("zxy", values * turn)
        case "rotvec":
            return Rotation.from_rotvec(values * turn)
        case "yaw":
            return Rotation.from_euler("z", values * turn)
        case _:
            return Rotation.from_rotvec(np.zeros((len(values), 3)))


def _require_unit(quaternions: np.ndarray, where: str) -> None:
    """Raises DataError naming the first step of quaternions (T, 4) whose length is not 1."""
    length = np.linalg.norm(quaternions, axis=1)
    wrong = np.flatnonzero(np.abs(length - 1) > QUATERNION_TOLERANCE)
    if len(wrong):
        fix = "is this the version of the dataset that the registry describes? Or leave the episode out with --skip-bad"
        raise DataError(where, "rotation", "unit quaternions", f"length {length[wrong[0]]:.4g} at step {wrong[0]}", fix)


_ROTATION_SIZE = {"rpy": 3, "ypr": 3, "zxy": 3, "xyzw": 4, "wxyz": 4, "rotvec": 3, "yaw": 1, "none": 0}


def _require_width(values: np.ndarray, rotation: RotationKind, where: str, name: str) -> None:
    """Raises DataError unless values (T, n) can be a position and a rotation: those of another version often cannot."""
    widths = (16,) if rotation == "matrix" else (1, 2, 3) if rotation == "none" else (3 + _ROTATION_SIZE[rotation],)
    if values.shape[1] not in widths:
        _refuse_width(" or ".join(map(str, widths)), values, where, name)


def _pose_matrix(matrix: np.ndarray, episode: RldsEpisode) -> np.ndarray:
    end, fix = np.array([0.0, 0.0, 0.0, 1.0]), "is this the right dataset? Or leave the episode out with --skip-bad"
    for candidate in (matrix, matrix.transpose(0, 2, 1)):
        if np.allclose(candidate[:, 3], end, atol=1e-3):
            break
    else:
        got = np.array2string(matrix[0, 3], precision=3)
        raise DataError(episode.where, "pose", "a 4 x 4 pose ending in 0 0 0 1", got, fix)
    turned = candidate[:, :3, :3]
    # Neither stretched nor mirrored, to what rounding and a controller's drift leave.
    off = np.abs(turned @ turned.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    wrong = np.flatnonzero((off > 0.05) | (np.linalg.det(turned) < 0))
    if len(wrong):
        raise DataError(episode.where, "pose", "rotations", f"another matrix at step {wrong[0]}", fix)
    return candidate
