"""A demonstration as a robot recorded it -> an episode: what is checked, and which frames become samples.

Everything that people get wrong when they bring their own data is refused here with its name, the observation it was
found in and the fix: units, orders, sizes, cameras that look the other way, rotations that are none.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Literal

import jax
import numpy as np

from data_pipelines.records import Episode, make_episode
from dsvla_jax.encoding.keypoints import replay_latch
from dsvla_jax.errors import DataError
from dsvla_jax.observation_checks import (
    KEYPOINT_FIX,
    check_camera,
    check_keypoints,
    check_pictures,
    check_poses,
    has_words,
)
from dsvla_jax.types import Camera, Picture, join_cameras

# Metres, and as much in a rotation matrix: a camera that moves less in a whole demonstration stands still.
STANDS_STILL = 0.01


@dataclasses.dataclass(frozen=True)
class CameraRecording:
    """What one camera recorded in T observations.

    rgb: T pictures uint8 (H, W, 3). depth: T maps float (H, W), planar, 0 where there is no reading. Both
        may be any sequence, also one that reads files when asked: only frames that become samples are looked at.
    intrinsics: (3, 3), or (T, 3, 3) of a camera that changes, for pictures of exactly this size.
    world_from_camera: (4, 4), or (T, 4, 4) of a camera that moves: camera-to-world, z forward.
    """

    rgb: Sequence[np.ndarray]
    depth: Sequence[np.ndarray]
    intrinsics: np.ndarray
    world_from_camera: np.ndarray


@dataclasses.dataclass(frozen=True)
class Recording:
    """One demonstration of T observations; arrays of any float type. World frame, metres, xyzw quaternions.

    task: the name under which demonstrations of one kind are kept together.
    instruction: what was to be done, in words.
    rgb, depth, intrinsics, world_from_camera: of the camera, or the first one: see `CameraRecording`.
    pose: (T, A, 7), the end-effectors. gripper_open: (T, A), 0 or 1. Of two arms the left one first.
    channels: the order of colours in `rgb`; what OpenCV reads is "bgr".
    keypoints: (A, K, 3), the points that each arm is to go near, in the order of the instruction; an arm with fewer
        than K repeats its last. None where they are not known.
    variation: which of the task's variations it is, None where nobody counts them.
    camera: the first camera's name, which is kept where there are others. other_cameras: those, by name, in order. All
        pictures have one size.
    """

    task: str
    instruction: str
    rgb: Sequence[np.ndarray]
    depth: Sequence[np.ndarray]
    intrinsics: np.ndarray
    world_from_camera: np.ndarray
    pose: np.ndarray
    gripper_open: np.ndarray
    keypoints: np.ndarray | None = None
    channels: Literal["rgb", "bgr"] = "rgb"
    variation: int | None = None
    camera: str = "front"
    other_cameras: Mapping[str, CameraRecording] = dataclasses.field(default_factory=dict)

    @property
    def cameras(self) -> dict[str, CameraRecording]:
        """All cameras by name, in their order."""
        first = CameraRecording(self.rgb, self.depth, self.intrinsics, self.world_from_camera)
        return {self.camera: first, **self.other_cameras}


def make_demonstration(
    recording: Recording,
    samples: Sequence[tuple[int, int]],
    seed: int,
    where: object = "recording",
    keypoint_fix: str = KEYPOINT_FIX,
) -> Episode:
    """The episode of a recording.

    A camera that stands still must see a keypoint in its first picture; one that moves, as on a wrist, need not. Of
    several that stand still, one must.

    Args:
        samples: (observation to look at, observation to go to) each, ascending; see ``keyframes.sample_starts``.
        seed: the demonstration's number, kept in the episode.
        where: names the recording in errors. keypoint_fix: what to do if the camera does not see the keypoints.

    Raises:
        DataError: anything that the module's head names, or no samples.
    """
    check_recording(recording, where)
    if not samples:
        raise DataError(where, "samples", "at least one keyframe to go to", "none", "record until the task is done")
    starts, targets = (np.array(column) for column in zip(*samples, strict=True))
    several = len(recording.cameras) > 1
    views = {
        name: _pictures_at(camera, starts, len(recording.pose), where, f", camera {name}" if several else "")
        for name, camera in recording.cameras.items()
    }
    sizes = sorted({one.rgb.shape[:2] for pictures, _ in views.values() for one in pictures})
    if several and len(sizes) > 1:
        raise DataError(
            where, "picture size", "one (height, width) for all cameras", str(sizes), "resize, intrinsics too"
        )
    keypoints, active = _active_keypoints(recording)
    problems = []
    for pictures, still in views.values():
        if still:
            camera, size = pictures[0].camera, pictures[0].rgb.shape[:2]
            try:
                check_keypoints(keypoints, camera.intrinsics, camera.world_from_camera, size, where, keypoint_fix)
            except DataError as error:
                problems.append(error)
    if problems and len(problems) == sum(still for _, still in views.values()):
        raise problems[0]
    pose = np.array(recording.pose, np.float64)
    pose[..., 3:] /= np.linalg.norm(pose[..., 3:], axis=-1, keepdims=True)
    return make_episode(
        task=recording.task,
        instruction=recording.instruction,
        seed=seed,
        pictures=[
            join_cameras([_as_rgb(one, recording.channels) for one in frame])
            for frame in zip(*(pictures for pictures, _ in views.values()), strict=True)
        ],
        pose=pose[starts],
        gripper_open=recording.gripper_open[starts],
        target_pose=pose[targets],
        target_gripper=recording.gripper_open[targets],
        keypoints=keypoints,
        active_keypoint=active[starts],
        variation=recording.variation,
        cameras=tuple(views),
    )


def _pictures_at(
    camera: CameraRecording, starts: np.ndarray, count: int, where: object, which: str
) -> tuple[list[Picture[np.ndarray]], bool]:
    """The checked pictures of a camera at some observations, and whether it stands still. which: names it in errors."""
    intrinsics, poses = (_per_observation(x, count) for x in (camera.intrinsics, camera.world_from_camera))
    pictures = []
    for start in starts:
        rgb, depth = np.asarray(camera.rgb[start]), np.asarray(camera.depth[start])
        place = f"{where}, observation {start}{which}"
        check_pictures(rgb, depth, place)
        check_camera(intrinsics[start], poses[start], rgb.shape[:2], place)
        pictures.append(Picture(rgb, depth, Camera(intrinsics[start], poses[start])))
    return pictures, bool(np.abs(poses - poses[0]).max() < STANDS_STILL)


def _as_rgb(picture: Picture[np.ndarray], channels: Literal["rgb", "bgr"]) -> Picture[np.ndarray]:
    return picture if channels == "rgb" else dataclasses.replace(picture, rgb=picture.rgb[..., ::-1])


def check_recording(recording: Recording, where: object) -> None:
    """Raises DataError unless texts, counts, poses and grippers are right. Looks at no picture."""
    if not recording.task.strip():
        raise DataError(where, "task", "words", "nothing", "say what is demonstrated")
    if not has_words(recording.instruction):
        got = repr(recording.instruction) if recording.instruction.strip() else "nothing"
        raise DataError(where, "instruction", "words", got, "say what is demonstrated")
    if "/" in recording.task:
        raise DataError(where, "task", "a name for files", repr(recording.task), "leave out the slash")
    if recording.channels not in ("rgb", "bgr"):
        raise DataError(
            where, "channels", "rgb or bgr", repr(recording.channels), "say the order of the pictures' colours"
        )
    pose, gripper = np.asarray(recording.pose), np.asarray(recording.gripper_open)
    if pose.ndim != 3 or pose.shape[1] not in (1, 2) or pose.shape[2] != 7:
        fix = "give x y z qx qy qz qw for each of one or two arms at every observation"
        fix += "; for one arm add its axis: pose[:, None]" if pose.ndim == 2 else ""
        raise DataError(where, "pose", "(T, A, 7) with A = 1 or 2", str(pose.shape), fix)
    count, arms = pose.shape[:2]
    if gripper.shape != (count, arms):
        raise DataError(where, "gripper_open", f"{(count, arms)} as of pose", str(gripper.shape), "give one an arm")
    if recording.camera in recording.other_cameras or not all(recording.cameras):
        fix = "give each camera a name of its own"
        got = ", ".join(map(repr, [recording.camera, *recording.other_cameras]))
        raise DataError(where, "cameras", "different names", got, fix)
    for name, camera in recording.cameras.items():
        _check_camera_recording(camera, count, where if name == recording.camera else f"{where}, camera {name}")
    check_poses(pose, where)
    if wrong := sorted(set(gripper.ravel().tolist()) - {0.0, 1.0}):
        fix = "say when a width counts as open: (width > 0.5 * largest).astype(float)"
        raise DataError(where, "gripper_open", "0 (closed) or 1 (open)", f"{wrong[0]!r}", fix)
    if recording.keypoints is not None:
        shape = np.shape(recording.keypoints)
        if len(shape) != 3 or shape[0] != arms or shape[1] == 0 or shape[2] != 3:
            raise DataError(where, "keypoints", f"({arms}, K, 3) with K >= 1", str(shape), "or None where not known")


def _check_camera_recording(camera: CameraRecording, count: int, where: object) -> None:
    for field in ("rgb", "depth"):
        if len(getattr(camera, field)) != count:
            got = f"{len(getattr(camera, field))}"
            raise DataError(where, field, f"{count} pictures, one a pose", got, "record all streams in step")
    for field, value, shape in (
        ("intrinsics", camera.intrinsics, 3),
        ("world_from_camera", camera.world_from_camera, 4),
    ):
        if value is None or np.shape(value) not in ((shape, shape), (count, shape, shape)):
            got = "nothing" if value is None else str(np.shape(value))
            expected = f"({shape}, {shape}) or ({count}, {shape}, {shape})"
            raise DataError(where, field, expected, got, "give the camera's calibration; 3D input cannot do without")


def _per_observation(matrix: np.ndarray, count: int) -> np.ndarray:
    matrix = np.asarray(matrix, np.float64)
    return np.broadcast_to(matrix, (count, *matrix.shape[-2:]))


_jitted_latch = jax.jit(replay_latch)


def _active_keypoints(recording: Recording) -> tuple[np.ndarray, np.ndarray]:
    """Keypoints (A, K, 3) and the one each arm was heading for at every observation (T, A, 3); K may be 0."""
    count, arms = np.shape(recording.pose)[:2]
    if recording.keypoints is None:
        return np.zeros((arms, 0, 3), np.float32), np.zeros((count, 0, 3), np.float32)
    keypoints = np.asarray(recording.keypoints, np.float32)
    positions = np.asarray(recording.pose, np.float32)[..., :3]
    # Filled up with their last, which changes nothing, so that recordings of many lengths compile a few times only.
    padded = np.pad(positions, ((0, -count % 64), (0, 0), (0, 0)), "edge")
    points = np.pad(keypoints, ((0, 0), (0, -keypoints.shape[1] % 4), (0, 0)), "edge")
    return keypoints, np.asarray(_jitted_latch(padded, points))[:count]
