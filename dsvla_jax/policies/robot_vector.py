"""What a robot knows of itself and of its keypoints as one vector, for networks that read no numbers in text."""

import jax.numpy as jnp
from jaxtyping import Float

from dsvla_jax.encoding.codec import PoseCodec
from dsvla_jax.encoding.pose_inputs import ARMS
from dsvla_jax.policies.pose_vectors import VECTOR, center, scale_position, to_vectors
from dsvla_jax.types import Array, PoseInputs

# Wavelengths of `with_waves`: the shortest is 6 cm in a box of 2 m.
WAVES = 6


def robot_width(look_back: int = 0) -> int:
    """R, the length of `robot_vector`."""
    return ARMS * (VECTOR + 5) + (look_back * ARMS * VECTOR + 1 if look_back else 0)


def robot_vector(inputs: PoseInputs[Array], codec: PoseCodec, look_back: int = 0) -> Float[Array, "b r"]:
    """Each arm's pose and gripper (10), whether it is there, its keypoint from where it is (3), and whether one is.

    look_back: how many earlier states follow, with pose and gripper of each arm, and then keyframes so far, in tens.
    """
    there = inputs.arms[..., None]
    pose = inputs.robot.pose
    state = jnp.where(there, to_vectors(pose, inputs.robot.gripper_open, center(codec), codec), 0)
    near = there & inputs.has_keypoints[:, None, None]
    keypoints = jnp.where(near, scale_position(inputs.keypoints, pose[..., :3], codec), 0)
    parts = jnp.concatenate([state, there, keypoints, near], axis=-1)
    vector = parts.reshape(len(parts), -1)
    if not look_back:
        return vector
    before = inputs.past.robot
    earlier = to_vectors(before.pose[:, -look_back:], before.gripper_open[:, -look_back:], center(codec), codec)
    earlier = jnp.where(there[:, None], earlier, 0).reshape(len(parts), -1)
    return jnp.concatenate([vector, earlier, inputs.past.keyframes[:, None] / 10], axis=-1)


def with_waves(vector: Float[Array, "b r"]) -> Float[Array, "b w"]:
    """The vector, and sines and cosines of it at wavelengths from twice the box's half sides down to a 32nd of that.

    Whether an arm has reached a keypoint is a matter of centimetres, which a layer does not tell from metres.
    """
    angles = jnp.pi * vector[..., None] * 2.0 ** jnp.arange(WAVES)
    waves = jnp.concatenate([jnp.sin(angles), jnp.cos(angles)], axis=-1)
    return jnp.concatenate([vector, waves.reshape(len(vector), -1)], axis=-1)
