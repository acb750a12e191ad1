"""From a recorded frame to one example of a policy that answers with poses: augmentation, two arms, the instruction."""

from collections.abc import Callable

import numpy as np

from data_pipelines.records import Frame
from data_pipelines.samples import vary
from dsvla_jax.data_config import DataConfig
from dsvla_jax.encoding.pose_inputs import encode_instruction, pose_inputs, with_two_arms
from dsvla_jax.encoding.text import Tokenizer
from dsvla_jax.types import PoseExample


def make_pose_sampler(
    data: DataConfig, tokenizer: Tokenizer, words: int, use_keypoints: bool, upcoming: int
) -> Callable[[Frame, np.random.Generator], PoseExample[np.ndarray]]:
    """``sample(frame, rng)``: varies the frame as `data` says.

    words: T, the tokens that an instruction is padded to. use_keypoints: whether the policy is given the keypoint.
    upcoming: U, keyframes to learn.
    """

    def sample(frame: Frame, rng: np.random.Generator) -> PoseExample[np.ndarray]:
        frame = vary(frame, rng, data)
        keypoints = frame.keypoint if use_keypoints and len(frame.keypoint) else None
        text = encode_instruction(tokenizer, frame.instruction, words)
        poses, grippers = frame.target.pose[None], frame.target.gripper_open[None]
        if frame.later is not None:
            poses = np.concatenate([poses, frame.later.pose])
            grippers = np.concatenate([grippers, frame.later.gripper_open])
        places = np.minimum(np.arange(upcoming), len(poses) - 1)
        return PoseExample(
            pose_inputs(frame.pictures, frame.robot, text, keypoints, frame.past),
            with_two_arms(poses[places], axis=1),
            with_two_arms(grippers[places], axis=1),
        )

    return sample
