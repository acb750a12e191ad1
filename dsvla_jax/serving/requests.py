"""What a robot asks: a message checked field by field, before it can get anywhere near the other robots' requests."""

import contextlib
import dataclasses
from typing import Any

import numpy as np

from dsvla_jax.encoding.codec import PoseCodec
from dsvla_jax.encoding.config import EncodingConfig
from dsvla_jax.errors import DataError, UserError
from dsvla_jax.observation_checks import (
    check_camera,
    check_keypoints,
    check_pictures,
    check_poses,
    check_workspace,
    points_in_workspace,
)
from dsvla_jax.types import Camera, Observation, Picture, RobotState

MAX_KEYPOINTS = 16
MAX_PROMPT = 1000  # characters
FIELDS = {
    "prompt": "str, the instruction",
    "rgb": "uint8 (H, W, 3)",
    "depth": "float (H, W), planar, metres; 0 or non-finite where there is no reading",
    "intrinsics": "float (3, 3), pixels",
    "world_from_camera": "float (4, 4), camera to world, metres",
    "pose": "float (A, 7), each arm's x y z qx qy qz qw in the world frame, metres, the left arm first",
    "gripper_open": "float (A,), 1 open, 0 closed, nothing between",
}
# A policy that looks at the picture and its own state only does without these.
DEPTH_FIELDS = ("depth", "intrinsics", "world_from_camera")
OPTIONAL_FIELDS = {
    "keypoints": f"float (A, K, 3), metres, world frame, in the order of the instruction, K at most {MAX_KEYPOINTS}",
    "reset": "bool, True with the first request of an episode",
}


class BadRequest(UserError):
    """A request that cannot be answered; the message goes back to the robot that sent it."""


@dataclasses.dataclass(frozen=True)
class Expected:
    """What a server has compiled for.

    image_sizes: (H, W) each. arms: numbers of arms. encoding: of the policy, which knows both workspaces.
    keypoints: whether robots may send keypoints. depth: whether the policy, or what finds keypoints, reads depth.
    """

    image_sizes: tuple[tuple[int, int], ...]
    arms: tuple[int, ...]
    encoding: EncodingConfig
    keypoints: bool = True
    depth: bool = True

    @property
    def codec(self) -> PoseCodec:
        """Its box is the arms' workspace."""
        return self.encoding.codec

    @property
    def required(self) -> dict[str, str]:
        """The fields of every request, described."""
        return {name: what for name, what in FIELDS.items() if self.depth or name not in DEPTH_FIELDS}

    @property
    def optional(self) -> dict[str, str]:
        """The other fields, described."""
        others = {name: what for name, what in FIELDS.items() if name not in self.required}
        return others | OPTIONAL_FIELDS

    @property
    def max_message_bytes(self) -> int:
        """Bytes of the largest request that is read.

        Colour and depth count in double precision, so that a picture of another type arrives and is refused by its
        name.
        """
        return max(height * width for height, width in self.image_sizes) * (3 + 1) * 8 + 2**16


@dataclasses.dataclass(frozen=True)
class Request:
    """One observation, float32 and uint8 NumPy arrays without a batch axis.

    keypoints: float32 (A, K, 3), metres, world frame, or None. reset: whether an episode begins.
    points: of the depth map that lie in the policy's workspace, at its stride; None for a policy without 3D input.
    """

    instruction: str
    observation: Observation[np.ndarray]
    keypoints: np.ndarray | None
    reset: bool
    points: int | None = None

    @property
    def shape(self) -> tuple[int, int, int]:
        """(A, H, W): requests of one shape can be answered together."""
        return (len(self.observation.robot.pose), *self.observation.picture.rgb.shape[:2])


def parse_request(message: Any, expected: Expected) -> Request:
    """Checks and converts one message. What recordings refuse is refused here too.

    Raises BadRequest naming the field, what was expected, what came and the fix.
    """
    try:
        return _parse(message, expected)
    except DataError as error:
        raise BadRequest(str(error)) from error


def check_first_keypoints(request: Request, keypoints: np.ndarray) -> None:
    """Raises BadRequest unless an episode's first keypoints (A, K, 3) are before the camera, and one is in the picture.

    Finds an inverse or foreign world_from_camera. Later, objects may leave the view of a camera that moves.
    """
    picture = request.observation.picture
    camera, size = picture.camera, picture.depth.shape
    if not np.any(picture.depth):
        return  # neither depth nor camera was sent
    # Filled up with the last, which changes nothing, so that every number of keypoints runs what is compiled already.
    padded = np.pad(keypoints, ((0, 0), (0, max(MAX_KEYPOINTS - keypoints.shape[1], 0)), (0, 0)), "edge")
    where = (np.asarray(camera.intrinsics), np.asarray(camera.world_from_camera), size, "request")
    with contextlib.suppress(DataError):
        return check_keypoints(padded, *where)
    try:
        check_keypoints(keypoints, *where)  # for its message, which lists them
    except DataError as error:
        raise BadRequest(str(error)) from error


def _parse(message: Any, expected: Expected) -> Request:
    if not isinstance(message, dict):
        raise BadRequest(f"request: expected a map with {', '.join(expected.required)}, got {type(message).__name__}")
    unknown = sorted(repr(key)[:40] for key in message if key not in FIELDS and key not in OPTIONAL_FIELDS)
    missing = [name for name in expected.required if name not in message]
    if sent := [name for name in DEPTH_FIELDS if name in message]:
        missing += [name for name in DEPTH_FIELDS if name not in {*sent, *missing}]  # these go together
    if unknown or missing:
        described = "; ".join(f"{name}: {what}" for name, what in {**FIELDS, **OPTIONAL_FIELDS}.items())
        raise BadRequest(f"request: missing {missing}, unknown {unknown[:8]}; the fields are {described}")
    instruction, reset = message["prompt"], message.get("reset", False)
    if not isinstance(instruction, str) or not instruction.strip() or len(instruction) > MAX_PROMPT:
        raise BadRequest(f"prompt: expected 1 to {MAX_PROMPT} characters, got {_describe(instruction)}")
    if not isinstance(reset, bool | np.bool_):
        raise BadRequest(f"reset: expected {OPTIONAL_FIELDS['reset']}, got {_describe(reset)}")

    rgb = message["rgb"]
    sizes = " or ".join(f"({height}, {width}, 3)" for height, width in expected.image_sizes)
    if not isinstance(rgb, np.ndarray) or rgb.dtype != np.uint8 or rgb.shape[2:] != (3,):
        scale = "; multiply numbers from 0 to 1 by 255" if isinstance(rgb, np.ndarray) and rgb.dtype.kind == "f" else ""
        raise BadRequest(f"rgb: expected a uint8 array {sizes}, got {_describe(rgb)}; send uint8{scale}")
    if rgb.shape[:2] not in expected.image_sizes:
        raise BadRequest(
            f"rgb: expected {sizes}, got {rgb.shape}; resize it with its depth and intrinsics, or start the server "
            "with --image-size HEIGHTxWIDTH"
        )
    depth, camera, points = _depth_and_camera(message, rgb, expected)
    pose = _floats(message, "pose", (None, 7))
    arms = len(pose)
    if arms not in expected.arms:
        known = " or ".join(map(str, expected.arms))
        raise BadRequest(f"pose: expected {known} arm(s), got {arms}; start the server with --arms {arms}")
    _check_inside("pose", pose[:, :3], expected.codec)
    check_poses(pose[None], "request")
    length = np.linalg.norm(pose[:, 3:], axis=-1, keepdims=True)
    unit_pose = np.concatenate([pose[:, :3], pose[:, 3:] / length], axis=-1)
    gripper_open = _floats(message, "gripper_open", (arms,))
    if wrong := sorted(set(gripper_open.tolist()) - {0.0, 1.0}):
        raise BadRequest(
            f"gripper_open: expected 0 (closed) or 1 (open), got {wrong[0]:g}; say when a width counts as open: "
            "(width > 0.5 * largest).astype(float)"
        )
    keypoints = None
    if message.get("keypoints") is not None:
        if not expected.keypoints:
            raise BadRequest("keypoints: this policy learned from demonstrations without any; leave the field out")
        keypoints = _floats(message, "keypoints", (arms, None, 3))
        if not 1 <= keypoints.shape[1] <= MAX_KEYPOINTS:
            raise BadRequest(f"keypoints: expected {OPTIONAL_FIELDS['keypoints']}, got K = {keypoints.shape[1]}")
        _check_inside("keypoints", keypoints, expected.codec)
    observation = Observation(Picture(message["rgb"], depth, camera), RobotState(unit_pose, gripper_open))
    return Request(instruction, observation, keypoints, bool(reset), points)


def _depth_and_camera(message: dict, rgb: np.ndarray, expected: Expected) -> tuple[Any, Camera, int | None]:
    """The depth map with 0 for every missing reading, its camera, and the points that the policy makes 3D tokens of."""
    if "depth" not in message:
        blank: Any = np.eye(4, dtype=np.float32)
        return np.zeros(rgb.shape[:2], np.float32), Camera(blank[:3, :3], blank), None
    depth = _floats(message, "depth", rgb.shape[:2], finite=False)
    depth = np.where(np.isfinite(depth), depth, np.float32(0))
    intrinsics = _floats(message, "intrinsics", (3, 3))
    world_from_camera = _floats(message, "world_from_camera", (4, 4))
    check_pictures(rgb, depth, "request")
    check_camera(intrinsics.astype(np.float64), world_from_camera.astype(np.float64), rgb.shape[:2], "request")
    encoding, points = expected.encoding, None
    if encoding.use_points:
        stride, box = encoding.stride, (encoding.workspace_low, encoding.workspace_high)
        candidates = depth[::stride, ::stride]
        strided = np.diag([1 / stride, 1 / stride, 1]) @ intrinsics
        points, readings = points_in_workspace(candidates, strided, world_from_camera, *box)
        blocked = "is something in front of the camera?"
        try:
            check_workspace(points, readings, *box, "request")
        except DataError as error:
            raise BadRequest(f"{error}; {blocked}") from error
        if points < encoding.num_point_tokens:
            raise BadRequest(
                f"depth: expected at least {encoding.num_point_tokens} points in the workspace, one for each 3D token, "
                f"got {points} of {candidates.size} pixels; check that the depth stream is on; {blocked}"
            )
    return depth, Camera(intrinsics, world_from_camera), points


def _floats(message: dict, name: str, shape: tuple[int | None, ...], finite: bool = True) -> Any:
    what, value = {**FIELDS, **OPTIONAL_FIELDS}[name], message[name]
    if not isinstance(value, np.ndarray | list):
        raise BadRequest(f"{name}: expected {what}, got {_describe(value)}")
    if name == "depth" and isinstance(value, np.ndarray) and value.dtype.kind in "iu":
        raise BadRequest(f"depth: expected {what}, got {value.dtype}; divide millimetres by 1000")
    try:
        with np.errstate(over="ignore"):
            array = np.asarray(value, np.float32)
    except (ValueError, TypeError) as error:
        raise BadRequest(f"{name}: expected {what} ({error})") from error
    if array.ndim != len(shape) or any(want not in (None, got) for want, got in zip(shape, array.shape, strict=True)):
        raise BadRequest(f"{name}: expected {what}, got shape {array.shape}")
    if finite and not np.isfinite(array).all():
        raise BadRequest(f"{name}: expected finite numbers")
    return array


def _check_inside(name: str, positions: np.ndarray, codec: PoseCodec) -> None:
    outside = (positions < np.array(codec.low)) | (positions > np.array(codec.high))
    if outside.any():
        worst = positions[outside.any(axis=-1)][0].tolist()
        raise BadRequest(
            f"{name}: {worst} is outside the workspace from {codec.low} to {codec.high}; "
            "expected metres in the world frame that the policy was trained in"
        )


def _describe(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return f"{value.dtype} {value.shape}"
    if isinstance(value, str):
        return f"{len(value)} characters"
    return type(value).__name__
