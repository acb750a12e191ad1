"""A dataset of the registry, and one episode of it as a `Motion`."""

import dataclasses
from collections.abc import Callable
from typing import Literal

import numpy as np

from data_pipelines.oxe.columns import Column, require_finite
from data_pipelines.oxe.motion import Motion
from data_pipelines.rlds.features import RldsEpisode
from dsvla_jax.errors import DataError
from dsvla_jax.observation_checks import has_words

Encoding = Literal["end_effector", "joints", "navigation"]
View = Literal["primary", "secondary", "wrist"]
VIEWS: tuple[View, ...] = ("primary", "secondary", "wrist")


@dataclasses.dataclass(frozen=True)
class Depth:
    """Calibrated depth beside the primary picture; keys of the observation. unit: metres a count.

    intrinsics: (3, 3). camera_from_world: (4, 4), the extrinsic matrix with z forward, x right, y down.
    """

    key: str
    unit: float
    intrinsics: str
    camera_from_world: str

    def cameras(self, episode: RldsEpisode) -> tuple[np.ndarray, np.ndarray]:
        """Intrinsics (T, 3, 3) and world_from_camera (T, 4, 4) of an episode of T steps, float32.

        Raises DataError where a matrix is missing, misshapen, not finite or cannot be inverted.
        """
        paths = [f"steps/observation/{name}" for name in (self.intrinsics, self.camera_from_world)]
        intrinsics, camera_from_world = (episode.column(path) for path in paths)
        require_finite(intrinsics, episode.where, paths[0])
        require_finite(camera_from_world, episode.where, paths[1])
        try:
            world_from_camera = np.linalg.inv(camera_from_world.astype(np.float64))
        except np.linalg.LinAlgError as error:
            fix = "leave the episode out with --skip-bad"
            raise DataError(episode.where, paths[1], "matrices that can be inverted", "another", fix) from error
        return intrinsics, world_from_camera.astype(np.float32)


@dataclasses.dataclass(frozen=True)
class ArmColumns:
    """Where one arm's motion stands in an episode.

    pose: (T, 7). action: (T, 6). gripper: (T,), commanded openness. gripper_state: (T,), measured openness.
    joints: (T, J). keyframe: (T, 7), for datasets whose action is the next keyframe. It is then the target, with
    `gripper`, whatever the horizon.
    """

    gripper: Column
    pose: Column | None = None
    action: Column | None = None
    gripper_state: Column | None = None
    joints: Column | None = None
    keyframe: Column | None = None


@dataclasses.dataclass(frozen=True)
class OxeDataset:
    """How one dataset records its robot's motion.

    hz: steps a second. source: where it is published. images: observation keys of the views.
    language: path of the instruction in a step (text, or code points where `code_points`).
    bgr: views whose pictures have red and blue exchanged.
    metric: positions and actions are metres and radians; False where the publisher does not say so, or they are scaled.
    frame: of `Arm.action`. first: steps left out at the start. stride: every how many steps one is kept.
    keep: which episodes are used. notes: traps, and how each is handled.
    """

    name: str
    hz: float
    source: str
    images: dict[View, str]
    arms: tuple[ArmColumns, ...]
    language: str = "language_instruction"
    code_points: bool = False
    bgr: tuple[View, ...] = ()
    encoding: Encoding = "end_effector"
    metric: bool = True
    frame: Literal["base", "tool"] = "base"
    depth: Depth | None = None
    first: int = 0
    stride: int = 1
    keep: Callable[[RldsEpisode], bool] | None = None
    version: str | None = None
    notes: tuple[str, ...] = ()

    @property
    def has_pose(self) -> bool:
        """Whether the dataset records the pose of every end-effector."""
        return all(arm.pose is not None for arm in self.arms)

    def steps(self, episode: RldsEpisode) -> np.ndarray:
        """Numbers of the steps that are used, in order."""
        return np.arange(self.first, episode.num_steps, self.stride)

    def motion(self, episode: RldsEpisode) -> Motion:
        """The standardised motion of the steps that are used.

        Raises DataError naming the record where a column is missing, misshapen or not finite.
        """
        steps = self.steps(episode)
        if not len(steps):
            fix = "leave it out with --skip-bad"
            raise DataError(episode.where, "steps", f"more than {self.first}", str(episode.num_steps), fix)
        command = _columns(episode, [arm.gripper for arm in self.arms], "gripper")
        assert command is not None
        state = _columns(episode, [arm.gripper_state for arm in self.arms], "gripper state")
        # Where it is not measured, the gripper is where the last command sent it.
        state = np.concatenate([command[:1], command[:-1]]) if state is None else state
        pose, action, joints, keyframe = (
            None if values is None else values[steps]
            for values in (
                _columns(episode, [arm.pose for arm in self.arms], "pose"),
                _columns(episode, [arm.action for arm in self.arms], "action"),
                _columns(episode, [arm.joints for arm in self.arms], "joints"),
                _columns(episode, [arm.keyframe for arm in self.arms], "keyframe"),
            )
        )
        return Motion(self._instruction(episode), pose, state[steps], action, command[steps], joints, keyframe)

    def _instruction(self, episode: RldsEpisode) -> str:
        """Of the first step, without the space around it; nothing where it has no words."""
        path = f"steps/{self.language}"
        if self.code_points:
            points = episode.column(path)[0].astype(np.uint8)
            text = bytes(points).split(b"\0")[0].decode(errors="replace")
        else:
            text = episode.text(path)[0]
        return text.strip() if has_words(text) else ""


def _columns(episode: RldsEpisode, columns: list[Column | None], name: str) -> np.ndarray | None:
    """float32 (T, A, ...) of one column an arm, or None where an arm has none."""
    present = [column for column in columns if column is not None]
    if len(present) < len(columns):
        return None
    values = np.stack([column(episode) for column in present], axis=1).astype(np.float32)
    require_finite(values, episode.where, name)
    return values
