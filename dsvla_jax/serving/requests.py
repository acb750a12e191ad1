"""What a robot asks: a message checked field by field, before it can get anywhere near the other robots' requests."""

import contextlib
import dataclasses

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
from dsvla_jax.types import Camera, Observation, Picture, RobotState, split_cameras

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
    cameras: the names of those whose pictures robots send. Of one camera, fields have no camera axis; of several they
    have one in front, in the order of the names.
    """

    image_sizes: tuple[tuple[int, int], ...]
    arms: tuple[int, ...]
    encoding: EncodingConfig
    keypoints: bool = True
    depth: bool = True
    cameras: tuple[str, ...] = ("camera",)

    @property
    def codec(self) -> PoseCodec:
        """Its box is the arms' workspace."""
        return self.encoding.codec

    @property
    def required(self) -> dict[str, str]:
        """The fields of every request, described."""
        return {name: what for name, what in self.fields.items() if self.depth or name not in DEPTH_FIELDS}

    @property
    def fields(self) -> dict[str, str]:
        """All fields but the optional ones, described."""
        count = len(self.cameras)
        if count == 1:
            return FIELDS
        order = f", of each of {', '.join(self.cameras)}"
        more = {name: FIELDS[name].replace("(", f"({count}, ", 1) + order for name in ("rgb", *DEPTH_FIELDS)}
        return {**FIELDS, **more}

    @property
    def optional(self) -> dict[str, str]:
        """The other fields, described."""
        others = {name: what for name, what in self.fields.items() if name not in self.required}
        return others | OPTIONAL_FIELDS

    @property
    def max_message_bytes(self) -> int:
        """Bytes of the largest request that is read.

        Colour and depth count in double precision, so that a picture of another type arrives and is refused by its
        name.
        """
        pixels = max(height * width for height, width in self.image_sizes) * len(self.cameras)
        return pixels * (3 + 1) * 8 + 2**16


@dataclasses.dataclass(frozen=True)
class Request:
    """One observation, float32 and uint8 NumPy arrays without a batch axis.

    keypoints: float32 (A, K, 3), metres, world frame, or None. reset: whether an episode begins.
    points: of the depth maps that lie in the policy's workspace, at its stride; None for a policy without 3D input.
    """

    instruction: str
    observation: Observation[np.ndarray]
    keypoints: np.ndarray | None
    reset: bool
    points: int | None = None

    @property
    def shape(self) -> tuple[int, int, int]:
        """(A, H, W): requests of one shape can be answered together."""
        return (len(self.observation.robot.pose), *self.observation.pictures.rgb.shape[1:3])


def parse_request(message: object, expected: Expected) -> Request:
    """Checks and converts one message. What recordings refuse is refused here too.

    Raises BadRequest naming the field, what was expected, what came and the fix.
    """
    try:
        return _parse(message, expected)
    except DataError as error:
        raise BadRequest(str(error)) from error


def check_first_keypoints(request: Request, keypoints: np.ndarray) -> None:
    """Raises BadRequest unless an episode's first keypoints (A, K, 3) are before a camera, and one is in its picture.

    Finds an inverse or foreign world_from_camera. Later, objects may leave the view of a camera that moves. One of
    several cameras must see them: another one, such as on a wrist, need not.
    """
    pictures = request.observation.pictures
    if not np.any(pictures.depth):
        return  # neither depth nor camera was sent
    # Filled up with the last, which changes nothing, so that every number of keypoints runs what is compiled already.
    padded = np.pad(keypoints, ((0, 0), (0, max(MAX_KEYPOINTS - keypoints.shape[1], 0)), (0, 0)), "edge")
    looks = [
        (np.asarray(one.camera.intrinsics), np.asarray(one.camera.world_from_camera), one.depth.shape, "request")
        for one in split_cameras(pictures)
    ]
    for look in looks:
        with contextlib.suppress(DataError):
            return check_keypoints(padded, *look)
    try:
        check_keypoints(keypoints, *looks[0])  # for its message, which lists them
    except DataError as error:
        raise BadRequest(str(error)) from error


def _parse(message: object, expected: Expected) -> Request:
    if not isinstance(message, dict):
        raise BadRequest(f"request: expected a map with {', '.join(expected.required)}, got {type(message).__name__}")
    unknown = sorted(repr(key)[:40] for key in message if key not in FIELDS and key not in OPTIONAL_FIELDS)
    missing = [name for name in expected.required if name not in message]
    if sent := [name for name in DEPTH_FIELDS if name in message]:
        missing += [name for name in DEPTH_FIELDS if name not in {*sent, *missing}]  # these go together
    if sent and not expected.depth and missing and not unknown:
        together = f"{', '.join(DEPTH_FIELDS)} go together: send all of them, or none"
        raise BadRequest(f"request: missing {', '.join(missing)}; {together}")
    if unknown or missing:
        described = "; ".join(f"{name}: {what}" for name, what in {**expected.fields, **OPTIONAL_FIELDS}.items())
        lacks = f"missing {', '.join(missing) or 'none'}, unknown {', '.join(unknown[:8]) or 'none'}"
        raise BadRequest(f"request: {lacks}; the fields are {described}")
    instruction, reset = message["prompt"], message.get("reset", False)
    if not isinstance(instruction, str) or not instruction.strip() or len(instruction) > MAX_PROMPT:
        raise BadRequest(f"prompt: expected 1 to {MAX_PROMPT} characters, got {_describe(instruction)}")
    if not isinstance(reset, bool | np.bool_):
        raise BadRequest(f"reset: expected {OPTIONAL_FIELDS['reset']}, got {_describe(reset)}")

    pictures, points = _pictures(message, expected)
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
    observation = Observation(pictures, RobotState(unit_pose, gripper_open))
    return Request(instruction, observation, keypoints, bool(reset), points)


def _pictures(message: dict, expected: Expected) -> tuple[Picture[np.ndarray], int | None]:
    """The pictures of all cameras, and how many of their points the policy makes 3D tokens of."""
    rgb = _rgb(message["rgb"], expected)
    count, *size = rgb.shape[:3]
    if "depth" not in message:
        blank = np.tile(np.eye(4, dtype=np.float32), (count, 1, 1))
        return Picture(rgb, np.zeros((count, *size), np.float32), Camera(blank[:, :3, :3], blank)), None
    fields = expected.fields

    def of_cameras(name: str, shape: tuple[int, ...], finite: bool = True) -> np.ndarray:
        axis = (count,) if len(expected.cameras) > 1 else ()
        return _floats(message, name, (*axis, *shape), finite, fields[name]).reshape(count, *shape)

    depth = of_cameras("depth", tuple(size), finite=False)
    depth = np.where(np.isfinite(depth), depth, np.float32(0))
    camera = Camera(of_cameras("intrinsics", (3, 3)), of_cameras("world_from_camera", (4, 4)))
    pictures = Picture(rgb, depth, camera)
    for name, one in zip(expected.cameras, split_cameras(pictures), strict=True):
        where = "request" if count == 1 else f"request, camera {name}"
        check_pictures(one.rgb, one.depth, where)
        calibration = (one.camera.intrinsics.astype(np.float64), one.camera.world_from_camera.astype(np.float64))
        check_camera(*calibration, one.rgb.shape[:2], where)
    return pictures, _count_points(pictures, expected.encoding) if expected.encoding.use_points else None


def _rgb(rgb: object, expected: Expected) -> np.ndarray:
    """uint8 (C, H, W, 3)."""
    count = len(expected.cameras)
    axis = "" if count == 1 else f"{count}, "
    sizes = " or ".join(f"({axis}{height}, {width}, 3)" for height, width in expected.image_sizes)
    if count > 1:
        sizes += f" of {', '.join(expected.cameras)}"
    if not isinstance(rgb, np.ndarray) or rgb.dtype != np.uint8 or rgb.ndim != 3 + (count > 1) or rgb.shape[-1] != 3:
        raise BadRequest(f"rgb: expected a uint8 array {sizes}, got {_describe(rgb)}; {_fix_of(rgb)}")
    stacked = rgb if count > 1 else rgb[None]
    if len(stacked) != count or stacked.shape[1:3] not in expected.image_sizes:
        raise BadRequest(
            f"rgb: expected {sizes}, got {rgb.shape}; resize it with its depth and intrinsics, or start the server "
            "with --image-size HEIGHTxWIDTH"
        )
    return stacked


def _fix_of(rgb: object) -> str:
    """What to do with a picture of another type or number of axes."""
    if not isinstance(rgb, np.ndarray) or rgb.dtype != np.uint8:
        floats = isinstance(rgb, np.ndarray) and rgb.dtype.kind == "f"
        return "send uint8" + ("; multiply numbers from 0 to 1 by 255" if floats else "")
    return "send one picture of each camera, without an axis for a single one"


def _count_points(pictures: Picture[np.ndarray], encoding: EncodingConfig) -> int:
    """How many points of all cameras lie in the workspace. Raises BadRequest if these are too few."""
    stride, box = encoding.stride, (encoding.workspace_low, encoding.workspace_high)
    candidates = pictures.depth[:, ::stride, ::stride]
    points = readings = 0
    for depth, one in zip(candidates, split_cameras(pictures), strict=True):
        strided = np.diag([1 / stride, 1 / stride, 1]) @ one.camera.intrinsics
        inside, measured = points_in_workspace(depth, strided, one.camera.world_from_camera, *box)
        points, readings = points + inside, readings + measured
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
    return points


def _floats(
    message: dict, name: str, shape: tuple[int | None, ...], finite: bool = True, described: str = ""
) -> np.ndarray:
    what, value = described or {**FIELDS, **OPTIONAL_FIELDS}[name], message[name]
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


def _describe(value: object) -> str:
    if isinstance(value, np.ndarray):
        return f"{value.dtype} {value.shape}"
    if isinstance(value, str):
        return f"{len(value)} characters"
    return type(value).__name__
