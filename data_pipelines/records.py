"""One demonstration episode as a record of bytes, and one frame of it as a training sample.

A record is a msgpack map of text, integers, arrays (``{"dtype", "shape", "data"}``, little-endian) and, for every
recorded frame and camera, an RGB picture as PNG and its depth as a 16-bit PNG in units of 0.1 mm (0 = missing reading).
Nothing is ever unpickled. A record of a single camera has no camera axis, and no names of cameras.

Axes: F recorded frames of an episode, and A, C, H, W, K of ``dsvla_jax.types``. World frame, metres, xyzw quaternions.
"""

import dataclasses
import math
import struct
from collections.abc import Sequence
from typing import Any, cast

import cv2
import msgpack
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from dsvla_jax.encoding.past import recorded_past
from dsvla_jax.errors import DataError
from dsvla_jax.observation_checks import MAX_DEPTH
from dsvla_jax.types import Action, Camera, Past, Picture, RobotState

RECORD_VERSION = 1
DEPTH_UNIT = 1e-4

_DTYPES = ("<f4", "<f8", "<i4", "<i8", "|u1", "|b1")
_LISTS = ("rgb_png", "depth_png", "cameras")
_CALIBRATION = ("intrinsics", "world_from_camera")


@dataclasses.dataclass(frozen=True)
class Episode:
    """One demonstration: what was seen before each key action, and the key action that the demonstrator took next.

    rgb_png, depth_png: F x C encoded pictures each (see ``encode_rgb`` and ``encode_depth``): all cameras of the first
        frame, then all of the next.
    intrinsics: float32 (F, C, 3, 3). world_from_camera: float32 (F, C, 4, 4).
    pose: float32 (F, A, 7). gripper_open: float32 (F, A). The state in which the frame was recorded.
    target_pose: float32 (F, A, 7). target_gripper: float32 (F, A). The next keyframe.
    keypoints: float32 (A, K, 3), in the order of the instruction. active_keypoint: float32 (F, A, 3). Where no keypoint
        is known, K is 0 and active_keypoint (F, 0, 3): such a demonstration is prompted without the constraint.
    seed: the number of the episode in its seed stream. variation: which of the task's variations it is, None where
        nobody counts them.
    cameras: the C names; empty for one camera, whose name an episode does not keep.
    """

    task: str
    instruction: str
    seed: int
    rgb_png: tuple[bytes, ...]
    depth_png: tuple[bytes, ...]
    intrinsics: np.ndarray
    world_from_camera: np.ndarray
    pose: np.ndarray
    gripper_open: np.ndarray
    target_pose: np.ndarray
    target_gripper: np.ndarray
    keypoints: np.ndarray
    active_keypoint: np.ndarray
    variation: int | None = None
    cameras: tuple[str, ...] = ()

    @property
    def num_cameras(self) -> int:
        """C."""
        return max(len(self.cameras), 1)

    @property
    def num_frames(self) -> int:
        """F."""
        return len(self.rgb_png) // self.num_cameras

    @property
    def num_arms(self) -> int:
        """A."""
        return self.pose.shape[1]


@dataclasses.dataclass(frozen=True)
class Frame:
    """One recorded moment of an episode, and the keyframe that follows."""

    pictures: Picture[np.ndarray]
    """One of each camera: rgb (C, H, W, 3), and so on."""
    robot: RobotState[np.ndarray]
    keypoint: Float[np.ndarray, "k 3"]
    """The active one of each arm, metres, world frame; none (K = 0) if none is known."""
    target: Action[np.ndarray]
    """The next keyframe."""
    instruction: str
    task: str
    task_index: int
    """The task's place among those of the reader."""
    episode: int
    """The episode's number in the reader's order."""
    frame: int
    """The frame's number in its episode."""
    past: Past[np.ndarray] | None = None
    """What the episode was before; None where nobody knows it."""
    later: Action[np.ndarray] | None = None
    """The keyframes behind the next one, (R, A, 7), R of 0 or more; None where nobody knows them."""


def encode_rgb(rgb: np.ndarray) -> bytes:
    """PNG of uint8 (H, W, 3)."""
    if rgb.dtype != np.uint8 or rgb.ndim != 3 or rgb.shape[-1] != 3:
        raise DataError("encode_rgb", "rgb", "uint8 (H, W, 3)", f"{rgb.dtype} {rgb.shape}", "convert the picture first")
    return _png(cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))


def encode_depth(depth: np.ndarray) -> bytes:
    """16-bit PNG of float (H, W) planar depth in metres, rounded to 0.1 mm; 0 marks a missing reading."""
    if depth.ndim != 2:
        raise DataError("encode_depth", "depth", "(H, W)", str(depth.shape), "drop the extra axes")
    if not np.all(np.isfinite(depth)):
        count = int(np.sum(~np.isfinite(depth)))
        raise DataError(
            "encode_depth", "depth", "finite values", f"{count} non-finite pixels", "write 0 for a missing reading"
        )
    if depth.min() < 0 or depth.max() > MAX_DEPTH:
        span = f"{depth.min():.4g} to {depth.max():.4g}"
        raise DataError(
            "encode_depth", "depth", f"0 to {MAX_DEPTH} m", span, "convert to metres and write 0 beyond the range"
        )
    return _png(np.rint(depth / DEPTH_UNIT).astype(np.uint16))


def decode_rgb(data: bytes) -> np.ndarray:
    """uint8 (H, W, 3) of a PNG or JPEG."""
    picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    if picture is None:
        raise DataError("decode_rgb", "rgb_png", "a PNG", f"{len(data)} undecodable bytes", "generate the data again")
    return cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)


def decode_depth(data: bytes) -> np.ndarray:
    """float32 (H, W) metres of a 16-bit PNG of ``encode_depth``."""
    picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if picture is None or picture.dtype != np.uint16 or picture.ndim != 2:
        got = "undecodable bytes" if picture is None else f"{picture.dtype} {picture.shape}"
        raise DataError("decode_depth", "depth_png", "a 16-bit grey PNG", got, "generate the data again")
    # In float64 first, so that the nearest float32 of the decimal value comes out.
    return (picture * DEPTH_UNIT).astype(np.float32)


def picture_size(png: bytes) -> tuple[int, int]:
    """(height, width) that the header of a PNG states."""
    width, height = struct.unpack(">II", png[16:24])
    return height, width


def mark_missing(depth: np.ndarray) -> np.ndarray:
    """Depth in metres with 0 wherever nothing was hit or it is too far for the format."""
    return np.where(np.isfinite(depth) & (depth > 0) & (depth <= MAX_DEPTH), depth, 0)


def _png(picture: np.ndarray) -> bytes:
    ok, data = cv2.imencode(".png", picture, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    if not ok:
        raise DataError("png", "picture", "an encodable array", f"{picture.dtype} {picture.shape}", "check its shape")
    return data.tobytes()


def make_episode(
    *,
    task: str,
    instruction: str,
    seed: int,
    pictures: Sequence[Picture[np.ndarray]],
    pose: ArrayLike,
    gripper_open: ArrayLike,
    target_pose: ArrayLike,
    target_gripper: ArrayLike,
    keypoints: ArrayLike,
    active_keypoint: ArrayLike,
    variation: int | None = None,
    cameras: Sequence[str] = (),
) -> Episode:
    """Encodes the pictures of F frames, each rgb uint8 (C, H, W, 3), depth float (C, H, W) and the C cameras.

    cameras: the C names; one camera needs none, and its name is not kept.
    """
    episode = Episode(
        task=task,
        instruction=instruction,
        seed=int(seed),
        rgb_png=tuple(encode_rgb(np.asarray(x)) for frame in pictures for x in frame.rgb),
        depth_png=tuple(encode_depth(np.asarray(x)) for frame in pictures for x in frame.depth),
        intrinsics=np.array([frame.camera.intrinsics for frame in pictures], np.float32),
        world_from_camera=np.array([frame.camera.world_from_camera for frame in pictures], np.float32),
        pose=np.asarray(pose, np.float32),
        gripper_open=np.asarray(gripper_open, np.float32),
        target_pose=np.asarray(target_pose, np.float32),
        target_gripper=np.asarray(target_gripper, np.float32),
        keypoints=np.asarray(keypoints, np.float32),
        active_keypoint=np.asarray(active_keypoint, np.float32),
        variation=variation,
        cameras=tuple(cameras) if len(cameras) > 1 else (),
    )
    check_episode(episode, f"episode {seed} of {task}")
    return episode


def check_episode(episode: Episode, where: object) -> None:
    """Raises DataError unless all shapes agree and every number is finite."""
    frames, cameras = episode.num_frames, episode.num_cameras
    arms = episode.pose.shape[1] if episode.pose.ndim == 3 else 1
    keypoints = episode.keypoints.shape[1] if episode.keypoints.ndim == 3 else 1
    expected = {
        "intrinsics": (frames, cameras, 3, 3),
        "world_from_camera": (frames, cameras, 4, 4),
        "pose": (frames, arms, 7),
        "gripper_open": (frames, arms),
        "target_pose": (frames, arms, 7),
        "target_gripper": (frames, arms),
        "keypoints": (arms, keypoints, 3),
        "active_keypoint": (frames, arms if keypoints else 0, 3),
    }
    fix = "generate the data again, or correct the importer that wrote it"
    if len(set(episode.cameras)) < len(episode.cameras) or len(episode.cameras) == 1:
        raise DataError(where, "cameras", "no name, or several different ones", str(episode.cameras), fix)
    for field in ("rgb_png", "depth_png"):
        if frames == 0 or len(getattr(episode, field)) != frames * cameras:
            expected_count = f"{max(frames, 1) * cameras} pictures"
            raise DataError(where, field, expected_count, str(len(getattr(episode, field))), fix)
    for field, shape in expected.items():
        value = getattr(episode, field)
        if value.shape != shape or value.dtype != np.float32:
            raise DataError(where, field, f"float32 {shape}", f"{value.dtype} {value.shape}", fix)
        if not np.isfinite(value).all():
            raise DataError(where, field, "finite numbers", f"{int(np.sum(~np.isfinite(value)))} non-finite", fix)


def select_cameras(episode: Episode, numbers: Sequence[int]) -> Episode:
    """The episode as seen by some of its cameras, in the order of their numbers."""
    chosen = [frame * episode.num_cameras + number for frame in range(episode.num_frames) for number in numbers]
    names = tuple(episode.cameras[number] for number in numbers) if episode.cameras else ()
    return dataclasses.replace(
        episode,
        rgb_png=tuple(episode.rgb_png[i] for i in chosen),
        depth_png=tuple(episode.depth_png[i] for i in chosen),
        intrinsics=episode.intrinsics[:, list(numbers)],
        world_from_camera=episode.world_from_camera[:, list(numbers)],
        cameras=names if len(names) > 1 else (),
    )


def pack_episode(episode: Episode) -> bytes:
    """The record of an episode; equal episodes give equal bytes."""

    def plain(value: object) -> object:
        if isinstance(value, np.ndarray):
            little = np.ascontiguousarray(value, value.dtype.newbyteorder("<"))
            return {"dtype": little.dtype.str, "shape": list(little.shape), "data": little.tobytes()}
        return list(value) if isinstance(value, tuple) else value

    values = {field.name: getattr(episode, field.name) for field in dataclasses.fields(episode)}
    if episode.variation is None:
        del values["variation"]
    if not episode.cameras:
        del values["cameras"]
        values |= {name: values[name][:, 0] for name in _CALIBRATION}
    fields = {name: plain(value) for name, value in values.items()}
    return cast(bytes, msgpack.packb({"version": RECORD_VERSION, **fields}, use_bin_type=True))


def unpack_episode(record: bytes, where: object = "episode record") -> Episode:
    """The inverse of ``pack_episode``; `where` names the record in errors."""
    fix = "generate the data again"
    try:
        fields = msgpack.unpackb(record, raw=False)
    except (msgpack.exceptions.UnpackException, ValueError) as error:
        raise DataError(where, "record", "a msgpack map", f"{len(record)} unreadable bytes ({error})", fix) from error
    version = fields.get("version") if isinstance(fields, dict) else None
    if version != RECORD_VERSION:
        raise DataError(where, "version", str(RECORD_VERSION), repr(version), fix)
    values: dict[str, Any] = {}  # as read: `check_episode` checks them
    for field in dataclasses.fields(Episode):
        if field.name not in fields:
            if field.default is not dataclasses.MISSING:
                continue
            raise DataError(where, field.name, "to be present", "nothing", fix)
        value = fields[field.name]
        if field.type is np.ndarray:
            value = _unpack_array(value, where, field.name)
        values[field.name] = tuple(value) if field.name in _LISTS else value
    if "cameras" not in values:
        values |= {name: values[name][:, None] for name in _CALIBRATION}
    episode = Episode(**values)
    check_episode(episode, where)
    return episode


def _unpack_array(value: object, where: object, field: str) -> np.ndarray:
    if not isinstance(value, dict) or value.get("dtype") not in _DTYPES:
        raise DataError(where, field, f"an array of {_DTYPES}", repr(value)[:60], "generate the data again")
    dtype, shape, data = np.dtype(value["dtype"]), tuple(value["shape"]), value["data"]
    if len(data) != dtype.itemsize * math.prod(shape):
        raise DataError(where, field, f"the bytes of {shape}", f"{len(data)} bytes", "generate the data again")
    return np.frombuffer(data, dtype).reshape(shape)


def _stack(pictures: Sequence[np.ndarray]) -> np.ndarray:
    """The pictures of C cameras as one array; that of one camera is not copied."""
    return pictures[0][None] if len(pictures) == 1 else np.stack(pictures)


def decode_frame(episode: Episode, place: int, task_index: int = 0, episode_number: int = 0) -> Frame:
    """One frame of an episode as a sample, with writable arrays."""
    mine = slice(place * episode.num_cameras, (place + 1) * episode.num_cameras)
    return Frame(
        pictures=Picture(
            _stack([decode_rgb(png) for png in episode.rgb_png[mine]]),
            _stack([decode_depth(png) for png in episode.depth_png[mine]]),
            Camera(episode.intrinsics[place].copy(), episode.world_from_camera[place].copy()),
        ),
        robot=RobotState(episode.pose[place].copy(), episode.gripper_open[place].copy()),
        keypoint=episode.active_keypoint[place].copy(),
        target=Action(episode.target_pose[place].copy(), episode.target_gripper[place].copy()),
        instruction=episode.instruction,
        task=episode.task,
        task_index=task_index,
        episode=episode_number,
        frame=place,
        past=recorded_past(episode.pose, episode.gripper_open, place),
        later=Action(episode.target_pose[place + 1 :].copy(), episode.target_gripper[place + 1 :].copy()),
    )
