"""What a robot asks: a message checked field by field, before it can get anywhere near the other robots' requests."""

import dataclasses
from typing import Any

import numpy as np

from dsvla_jax.encoding.codec import PoseCodec
from dsvla_jax.errors import UserError
from dsvla_jax.types import Camera, Observation

MAX_KEYPOINTS = 16
MAX_PROMPT = 1000  # characters
FIELDS = {
    "prompt": "str, the instruction",
    "rgb": "uint8 (H, W, 3)",
    "depth": "float (H, W), planar, metres; 0 where there is no reading",
    "intrinsics": "float (3, 3), pixels",
    "world_from_camera": "float (4, 4), camera to world, metres",
    "pose": "float (A, 7), each arm's x y z qx qy qz qw in the world frame, metres, the left arm first",
    "gripper_open": "float (A,), 1 open, 0 closed",
}
OPTIONAL_FIELDS = {
    "keypoints": f"float (A, K, 3), metres, world frame, in the order of the instruction, K at most {MAX_KEYPOINTS}",
    "reset": "bool, True with the first request of an episode",
}


class BadRequest(UserError):
    """A request that cannot be answered; the message goes back to the robot that sent it."""


@dataclasses.dataclass(frozen=True)
class Expected:
    """What a server has compiled for. image_sizes: (H, W) each. arms: numbers of arms. codec: knows the workspace."""

    image_sizes: tuple[tuple[int, int], ...]
    arms: tuple[int, ...]
    codec: PoseCodec

    @property
    def max_message_bytes(self) -> int:
        """The largest request: one picture with depth in double precision, and room for all else."""
        return max(height * width for height, width in self.image_sizes) * (3 + 8) + 2**16


@dataclasses.dataclass(frozen=True)
class Request:
    """One observation, float32 and uint8 NumPy arrays without a batch axis.

    keypoints: float32 (A, K, 3), metres, world frame, or None. reset: whether an episode begins.
    """

    instruction: str
    observation: Observation
    keypoints: np.ndarray | None
    reset: bool

    @property
    def shape(self) -> tuple[int, int, int]:
        """(A, H, W): requests of one shape can be answered together."""
        return (self.observation.pose.shape[0], *self.observation.depth.shape)  # type: ignore[return-value]


def parse_request(message: Any, expected: Expected) -> Request:
    """Checks and converts one message. Raises BadRequest naming the field, what was expected and what came."""
    if not isinstance(message, dict):
        raise BadRequest(f"request: expected a map with {', '.join(FIELDS)}, got {type(message).__name__}")
    unknown = sorted(repr(key)[:40] for key in message if key not in FIELDS and key not in OPTIONAL_FIELDS)
    missing = [name for name in FIELDS if name not in message]
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
        raise BadRequest(f"rgb: expected a uint8 array {sizes}, got {_describe(rgb)}")
    if rgb.shape[:2] not in expected.image_sizes:
        raise BadRequest(
            f"rgb: expected {sizes}, got {rgb.shape}; resize it with its depth and intrinsics, or start the server "
            "with --image-size HEIGHTxWIDTH"
        )
    depth = _floats(message, "depth", rgb.shape[:2], finite=False)
    intrinsics = _floats(message, "intrinsics", (3, 3))
    if intrinsics[0, 0] == 0 or intrinsics[1, 1] == 0 or not np.array_equal(intrinsics[2], (0, 0, 1)):
        raise BadRequest("intrinsics: expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with fx and fy not 0")
    world_from_camera = _floats(message, "world_from_camera", (4, 4))
    rotation = world_from_camera[:3, :3]
    if (
        not np.array_equal(world_from_camera[3], (0, 0, 0, 1))
        or np.abs(rotation).max() > 1.01
        or not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3)
        or np.linalg.det(rotation) < 0
    ):
        raise BadRequest("world_from_camera: expected a rotation and a translation with last row 0 0 0 1")

    pose = _floats(message, "pose", (None, 7))
    arms = len(pose)
    if arms not in expected.arms:
        known = " or ".join(map(str, expected.arms))
        raise BadRequest(f"pose: expected {known} arm(s), got {arms}; start the server with --arms {arms}")
    _check_inside("pose", pose[:, :3], expected.codec)
    length = np.linalg.norm(pose[:, 3:], axis=-1, keepdims=True)
    if np.any(np.abs(length - 1) > 0.1):
        raise BadRequest(f"pose: expected quaternions x y z w of length 1, got lengths {length[:, 0].tolist()}")
    unit_pose: Any = np.concatenate([pose[:, :3], pose[:, 3:] / length], axis=-1)
    gripper_open = _floats(message, "gripper_open", (arms,))
    keypoints = None
    if message.get("keypoints") is not None:
        keypoints = _floats(message, "keypoints", (arms, None, 3))
        if not 1 <= keypoints.shape[1] <= MAX_KEYPOINTS:
            raise BadRequest(f"keypoints: expected {OPTIONAL_FIELDS['keypoints']}, got K = {keypoints.shape[1]}")
        _check_inside("keypoints", keypoints, expected.codec)
    camera = Camera(intrinsics, world_from_camera)
    observation = Observation(rgb=message["rgb"], depth=depth, camera=camera, pose=unit_pose, gripper_open=gripper_open)
    return Request(instruction, observation, keypoints, bool(reset))


def _floats(message: dict, name: str, shape: tuple[int | None, ...], finite: bool = True) -> Any:
    what = {**FIELDS, **OPTIONAL_FIELDS}[name]
    value = message[name]
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
