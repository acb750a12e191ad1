"""The words every room of the project speaks.

Array dimensions are named by one letter everywhere, in this order of appearance:

    B  batch of examples or of parallel episodes      T  text tokens
    A  arms (1 or 2; the left arm first)              V  vocabulary
    H, W  image height and width, in pixels           D  feature channels
    P  points of a cloud                              G  3D tokens (groups); also FPS centres
    N  2D image patches                               K  neighbours, or keypoints where no cloud is near
    L  answer tokens

Lengths are metres, angles radians, images row-major. The world frame has z up and the table top at z = 0.752, as in
RLBench. A pose is [x, y, z, qx, qy, qz, qw] of the end-effector (the tool centre point between the finger tips) in
the world frame. Quaternions are xyzw, unit length, canonical (qw >= 0). ``gripper_open`` is 1 for open, 0 for closed.
"""

import jax
from flax import struct

Array = jax.Array

TABLE_HEIGHT = 0.752


@struct.dataclass
class Camera:
    """A pinhole camera in the RLBench/PyRep convention.

    intrinsics: float32 (3, 3). The focal lengths are negative for RLBench's cameras, and are never made positive:
        u = fx X / Z + cx, v = fy Y / Z + cy for a point (X, Y, Z) in the camera frame, Z > 0 in front.
    world_from_camera: float32 (4, 4), camera-to-world.
    """

    intrinsics: Array
    world_from_camera: Array


@struct.dataclass
class Observation:
    """What a policy may look at: one RGB-D picture, the robot's own state and the active keypoint of each arm.

    rgb: uint8 (H, W, 3).
    depth: float32 (H, W), planar Z in metres; 0 or a non-finite value marks a missing reading.
    camera: the camera of both.
    pose: float32 (A, 7). gripper_open: float32 (A,).
    """

    rgb: Array
    depth: Array
    camera: Camera
    pose: Array
    gripper_open: Array


@struct.dataclass
class Action:
    """The next key pose. pose: float32 (A, 7). gripper_open: float32 (A,), 0 or 1, applied once the pose is reached."""

    pose: Array
    gripper_open: Array


@struct.dataclass
class ModelInputs:
    """What the network eats; made from an Observation and text by ``dsvla_jax.encoding`` and nowhere else.

    image: float32 (S, S, 3), normalised as CLIP's.
    point_tokens: float32 (G, D3), from the 3D tokenizer; G = 0 for a policy without 3D input.
    point_patches: int32 (G,), the image patch (row-major) whose positional embedding each 3D token carries.
    text_tokens: int32 (T,), beginning-of-sequence, prompt [and answer], padded at the end.
    text_mask: bool (T,), False on padding.
    """

    image: Array
    point_tokens: Array
    point_patches: Array
    text_tokens: Array
    text_mask: Array
