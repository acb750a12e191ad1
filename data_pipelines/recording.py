"""A demonstration as a robot recorded it -> an episode: what is checked, and which frames become samples.

Everything that people get wrong when they bring their own data is refused here with its name, the observation it was
found in and the fix: units, orders, sizes, cameras that look the other way, rotations that are none.
"""

import dataclasses
from collections.abc import Sequence
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

# Metres, and as much in a rotation matrix: a camera that moves less in a whole demonstration stands still.
STANDS_STILL = 0.01


@dataclasses.dataclass(frozen=True)
class Recording:
    """One demonstration of T observations; arrays of any float type. World frame, metres, xyzw quaternions.

    task: the name under which demonstrations of one kind are kept together.
    instruction: what was to be done, in words.
    rgb: T pictures uint8 (H, W, 3). depth: T maps float (H, W), planar, 0 where there is no reading. Both
        may be any sequence, also one that reads files when asked: only frames that become samples are looked at.
    intrinsics: (3, 3), or (T, 3, 3) of a camera that changes, for pictures of exactly this size.
    world_from_camera: (4, 4), or (T, 4, 4) of a camera that moves: camera-to-world, z forward.
    pose: (T, A, 7), the end-effectors. gripper_open: (T, A), 0 or 1. Of two arms the left one first.
    channels: the order of colours in `rgb`; what OpenCV reads is "bgr".
    keypoints: (A, K, 3), the points that each arm is to go near, in the order of the instruction; an arm with fewer
        than K repeats its last. None where they are not known.
    variation: which of the task's variations it is, None where nobody counts them.
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


def make_demonstration(
    recording: Recording,
    samples: Sequence[tuple[int, int]],
    seed: int,
    where: object = "recording",
    keypoint_fix: str = KEYPOINT_FIX,
) -> Episode:
    """The episode of a recording.

    A camera that stands still must see a keypoint in its first picture; one that moves, as on a wrist, need not.

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
    count = len(recording.pose)
    intrinsics, cameras = (
        _per_observation(recording.intrinsics, count),
        _per_observation(recording.world_from_camera, count),
    )
    rgb = [np.asarray(recording.rgb[start]) for start in starts]
    depth = [np.asarray(recording.depth[start]) for start in starts]
    for start, picture, distances in zip(starts, rgb, depth, strict=True):
        place = f"{where}, observation {start}"
        check_pictures(picture, distances, place)
        check_camera(intrinsics[start], cameras[start], picture.shape[:2], place)
    keypoints, active = _active_keypoints(recording)
    if np.abs(cameras - cameras[0]).max() < STANDS_STILL:
        check_keypoints(keypoints, intrinsics[starts[0]], cameras[starts[0]], rgb[0].shape[:2], where, keypoint_fix)
    pose = np.array(recording.pose, np.float64)
    pose[..., 3:] /= np.linalg.norm(pose[..., 3:], axis=-1, keepdims=True)
    return make_episode(
        task=recording.task,
        instruction=recording.instruction,
        seed=seed,
        rgb=rgb if recording.channels == "rgb" else [picture[..., ::-1] for picture in rgb],
        depth=depth,
        intrinsics=intrinsics[starts],
        world_from_camera=cameras[starts],
        pose=pose[starts],
        gripper_open=recording.gripper_open[starts],
        target_pose=pose[targets],
        target_gripper=recording.gripper_open[targets],
        keypoints=keypoints,
        active_keypoint=active[starts],
        variation=recording.variation,
    )


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
    for field in ("rgb", "depth"):
        if len(getattr(recording, field)) != count:
            got = f"{len(getattr(recording, field))}"
            raise DataError(where, field, f"{count} pictures, one a pose", got, "record all streams in step")
    for field, value, shape in (
        ("intrinsics", recording.intrinsics, 3),
        ("world_from_camera", recording.world_from_camera, 4),
    ):
        if value is None or np.shape(value) not in ((shape, shape), (count, shape, shape)):
            got = "nothing" if value is None else str(np.shape(value))
            expected = f"({shape}, {shape}) or ({count}, {shape}, {shape})"
            raise DataError(where, field, expected, got, "give the camera's calibration; 3D input cannot do without")
    check_poses(pose, where)
    if wrong := sorted(set(gripper.ravel().tolist()) - {0.0, 1.0}):
        fix = "say when a width counts as open: (width > 0.5 * largest).astype(float)"
        raise DataError(where, "gripper_open", "0 (closed) or 1 (open)", f"{wrong[0]!r}", fix)
    if recording.keypoints is not None:
        shape = np.shape(recording.keypoints)
        if len(shape) != 3 or shape[0] != arms or shape[1] == 0 or shape[2] != 3:
            raise DataError(where, "keypoints", f"({arms}, K, 3) with K >= 1", str(shape), "or None where not known")


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
