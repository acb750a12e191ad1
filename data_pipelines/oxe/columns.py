"""The small vocabulary in which the registry says where a dataset keeps its robot's motion.

A column is a value: it is compared, printed and hashed by what it says, so that the index of a dataset can tell whether
its description has changed (`data_pipelines.oxe.index`).

Standard: positions in metres, rotations as unit quaternions xyzw or rotation vectors in radians, grippers 1 for open
and 0 for closed. A displacement is what is added to a position and multiplied from the left to a rotation
(``frame="base"``), or the same seen from the tool (``frame="tool"``).

Axes: T steps of an episode, n numbers of a step.
"""

import dataclasses
from typing import Literal, NoReturn, Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from data_pipelines.rlds.features import RldsEpisode
from dsvla_jax.errors import DataError
from dsvla_jax.observation_checks import QUATERNION_TOLERANCE

RotationKind = Literal["rpy", "ypr", "zxy", "xyzw", "wxyz", "rotvec", "matrix", "yaw", "none"]


class Column(Protocol):
    """Numbers of every step of an episode: (T, n), or (T,) for a gripper.

    Implementations are frozen dataclasses: their `repr` says what they read.
    """

    def __call__(self, episode: RldsEpisode) -> np.ndarray:
        """The numbers. Raises DataError if the episode does not have them."""
        ...


@dataclasses.dataclass(frozen=True)
class Read:
    """Columns `start` to `stop` of a feature of the steps, float64 (T, n)."""

    path: str
    start: int | None = None
    stop: int | None = None

    def __call__(self, episode: RldsEpisode) -> np.ndarray:
        """Raises DataError if the feature has fewer columns, or a number is not finite."""
        name = f"steps/{self.path}"
        values = episode.column(name).astype(np.float64)
        values = values.reshape(len(values), -1)
        if self.stop is not None and values.shape[1] < self.stop:
            _refuse_width(f"at least {self.stop}", values, episode.where, name)
        values = values[:, self.start : self.stop]
        # Here and not at the end: what is made of a column may not show that a number was missing.
        require_finite(values, episode.where, name)
        return values


@dataclasses.dataclass(frozen=True)
class Join:
    """Two columns side by side."""

    left: Column
    right: Column

    def __call__(self, episode: RldsEpisode) -> np.ndarray:
        """(T, n of both)."""
        return np.concatenate([self.left(episode), self.right(episode)], axis=1)


@dataclasses.dataclass(frozen=True)
class Pose:
    """Position (3, or without a rotation fewer: the rest is zero) and then rotation as poses (T, 7).

    scale, turn: metres and radians a unit. A matrix is 4 x 4, by rows or by columns, and takes no scale.
    """

    column: Column
    rotation: RotationKind
    scale: float = 1.0
    turn: float = 1.0

    def __call__(self, episode: RldsEpisode) -> np.ndarray:
        """(T, 7). Raises DataError if the numbers cannot be poses."""
        values = self.column(episode)
        _require_width(values, self.rotation, episode.where, "pose")
        if self.rotation == "matrix":
            matrix = _pose_matrix(values.reshape(-1, 4, 4), episode)
            position, turned = matrix[:, :3, 3], Rotation.from_matrix(matrix[:, :3, :3])
        else:
            size = _ROTATION_SIZE[self.rotation]
            position = values[:, : values.shape[1] - size]
            turned = as_rotation(values[:, position.shape[1] :], self.rotation, self.turn, episode.where)
        filled = np.zeros((len(values), 3))
        filled[:, : position.shape[1]] = position * self.scale
        return np.concatenate([filled, turned.as_quat(canonical=True)], axis=1)


@dataclasses.dataclass(frozen=True)
class Delta:
    """Translation (3, or without a rotation fewer) and then rotation of a step as displacements (T, 6).

    scale, turn: metres and radians a unit.
    """

    column: Column
    rotation: RotationKind
    scale: float = 1.0
    turn: float = 1.0

    def __call__(self, episode: RldsEpisode) -> np.ndarray:
        """(T, 6): metres and rotation vector."""
        values = self.column(episode)
        _require_width(values, self.rotation, episode.where, "action")
        size = _ROTATION_SIZE[self.rotation]
        moved = np.zeros((len(values), 6))
        moved[:, : values.shape[1] - size] = values[:, : values.shape[1] - size] * self.scale
        turns = values[:, values.shape[1] - size :]
        if self.rotation == "xyzw":
            # A step without a motion may be written as four zeros.
            turns = np.where(np.abs(turns).sum(1, keepdims=True) > 0, turns, [0.0, 0.0, 0.0, 1.0])
        moved[:, 3:] = as_rotation(turns, self.rotation, self.turn, episode.where).as_rotvec()
        return moved


@dataclasses.dataclass(frozen=True)
class InBase:
    """Displacements in the tool's frame (or, with `translation` false, their rotation alone) in the base's."""

    action: Column
    pose: Column
    translation: bool = True

    def __call__(self, episode: RldsEpisode) -> np.ndarray:
        """(T, 6)."""
        moved, tool = self.action(episode), Rotation.from_quat(self.pose(episode)[:, 3:])
        shift = tool.apply(moved[:, :3]) if self.translation else moved[:, :3]
        return np.concatenate([shift, tool.apply(moved[:, 3:])], axis=1)


@dataclasses.dataclass(frozen=True)
class Openness:
    """A reading mapped linearly so that `closed` gives 0 and `opened` gives 1, clipped to that."""

    column: Column
    closed: float
    opened: float

    def __call__(self, episode: RldsEpisode) -> np.ndarray:
        """(T,)."""
        return np.clip((self.column(episode)[:, 0] - self.closed) / (self.opened - self.closed), 0.0, 1.0)


@dataclasses.dataclass(frozen=True)
class Constant:
    """A gripper that never moves, or is not recorded."""

    value: float

    def __call__(self, episode: RldsEpisode) -> np.ndarray:
        """(T,)."""
        return np.full(episode.num_steps, self.value)


@dataclasses.dataclass(frozen=True)
class RelativeClosing:
    """Commands to close (> 0.1), open (< -0.1) or stay; before the first one, the state that it undoes."""

    column: Column

    def __call__(self, episode: RldsEpisode) -> np.ndarray:
        """(T,), 0 or 1."""
        values = self.column(episode)[:, 0]
        command = np.where(values > 0.1, 0.0, np.where(values < -0.1, 1.0, np.nan))
        given = np.flatnonzero(~np.isnan(command))
        if not len(given):
            return np.ones(len(values))
        last = np.maximum.accumulate(np.where(np.isnan(command), -1, np.arange(len(values))))
        return np.where(last < 0, 1.0 - command[given[0]], command[np.maximum(last, 0)])


@dataclasses.dataclass(frozen=True)
class Settled:
    """A continuous opening as 0 or 1, a half-way reading counting as the end that the motion reaches.

    Where the episode ends half-way, the readings since the last end are all the last one, as in octo and openvla.
    """

    column: Column

    def __call__(self, episode: RldsEpisode) -> np.ndarray:
        """(T,)."""
        values = self.column(episode)[:, 0]
        result = np.where(values > 0.95, 1.0, np.where(values < 0.05, 0.0, np.nan))
        following = float(values[-1]) if len(values) else 0.0
        for place in range(len(values) - 1, -1, -1):
            following = following if np.isnan(result[place]) else float(result[place])
            result[place] = following
        return result


@dataclasses.dataclass(frozen=True)
class Following:
    """The next step's values; the last step repeats its own. A measured opening becomes the command that it shows."""

    column: Column

    def __call__(self, episode: RldsEpisode) -> np.ndarray:
        """As the column."""
        values = self.column(episode)
        return np.concatenate([values[1:], values[-1:]])


@dataclasses.dataclass(frozen=True)
class Preceding:
    """The values of the step before; the first step repeats its own."""

    column: Column

    def __call__(self, episode: RldsEpisode) -> np.ndarray:
        """As the column."""
        values = self.column(episode)
        return np.concatenate([values[:1], values[:-1]])


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
