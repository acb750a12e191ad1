"""What a robot knows of itself and of its keypoints as one vector, for networks that read no numbers in text."""

import jax.numpy as jnp
from jaxtyping import Float

from dsvla_jax.encoding.codec import PoseCodec
from dsvla_jax.policies.pose_vectors import scale_position, to_vectors
from dsvla_jax.types import Array, PoseInputs


def robot_vector(inputs: PoseInputs[Array], codec: PoseCodec) -> Float[Array, "b 30"]:
    """Each arm's pose and gripper (10), whether it is there, its keypoint (3) and whether there is one."""
    there = inputs.arms[..., None]
    state = jnp.where(there, to_vectors(inputs.robot.pose, inputs.robot.gripper_open, codec), 0)
    near = there & inputs.has_keypoints[:, None, None]
    keypoints = jnp.where(near, scale_position(inputs.keypoints, codec), 0)
    parts = jnp.concatenate([state, there, keypoints, near], axis=-1)
    return parts.reshape(len(parts), -1)
