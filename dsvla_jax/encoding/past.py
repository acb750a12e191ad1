"""What an episode has been before the present observation, kept by whoever runs it: a policy stays a function."""

import numpy as np

from dsvla_jax.types import LOOK_BACK, NumpyOrJax, Past, RobotState, library_of


def first_past(robot: RobotState[NumpyOrJax]) -> Past[NumpyOrJax]:
    """The past of episodes that begin with these states: nothing but them. Any number of leading axes."""
    library = library_of(robot.pose)
    axis = robot.gripper_open.ndim - 1
    repeated = RobotState(
        library.stack([robot.pose] * LOOK_BACK, axis),
        library.stack([robot.gripper_open] * LOOK_BACK, axis),
    )
    return Past(repeated, library.zeros(robot.pose.shape[:axis], np.int32))


def remember(past: Past[NumpyOrJax], robot: RobotState[NumpyOrJax]) -> Past[NumpyOrJax]:
    """The past after one more keyframe, before which the robots were in these states."""
    library = library_of(robot.pose)
    axis = robot.gripper_open.ndim - 1

    def push(kept: NumpyOrJax, new: NumpyOrJax) -> NumpyOrJax:
        return library.concatenate([kept, library.expand_dims(new, axis)], axis)

    pose = push(past.robot.pose, robot.pose)[..., 1:, :, :]
    gripper_open = push(past.robot.gripper_open, robot.gripper_open)[..., 1:, :]
    return Past(RobotState(pose, gripper_open), library.asarray(past.keyframes + 1))


def recorded_past(pose: np.ndarray, gripper_open: np.ndarray, frame: int) -> Past[np.ndarray]:
    """The past of a frame of a recorded episode.

    pose: float32 (F, A, 7). gripper_open: float32 (F, A). The states before each keyframe, in their order.
    """
    places = np.maximum(np.arange(frame - LOOK_BACK, frame), 0)
    return Past(RobotState(pose[places], gripper_open[places]), np.asarray(frame, np.int32))
