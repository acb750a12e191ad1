"""What every dataset is brought to: `Motion`, in the conventions of `data_pipelines.oxe.columns`, two arms left first.

Axes: T steps of an episode, A arms, J joints.
"""

import dataclasses

import numpy as np


@dataclasses.dataclass(frozen=True)
class Motion:
    """One episode as the policy sees it, without its pictures. float32.

    instruction: empty where the episode has none. pose: (T, A, 7), or None where the data do not tell it.
    gripper_open: (T, A), as measured, or else as last commanded.
    action: (T, A, 6), commanded displacement of each step, translation and rotation vector; or None.
    gripper_command: (T, A). joints: (T, A, J) for datasets that tell joints only, else None. keyframe: (T, A, 7), each
    step's next keyframe, for datasets whose actions are keyframes, else None.
    """

    instruction: str
    pose: np.ndarray | None
    gripper_open: np.ndarray
    action: np.ndarray | None
    gripper_command: np.ndarray
    joints: np.ndarray | None = None
    keyframe: np.ndarray | None = None

    @property
    def num_steps(self) -> int:
        """T, the steps that are used."""
        return len(self.gripper_command)

    @property
    def num_arms(self) -> int:
        """A, the arms of the robot."""
        return self.gripper_command.shape[1]
