"""What every dataset is brought to: `Motion`, in the conventions of `data_pipelines.oxe.columns`, two arms left first.

Axes: T steps of an episode, A arms, J joints.
"""

import dataclasses

import numpy as np
from scipy.spatial.transform import Rotation


@dataclasses.dataclass(frozen=True)
class Motion:
    """One episode as the policy sees it, without its pictures. float32.

    instruction: empty where the episode has none. pose: (T, A, 7), or None where the data do not tell it.
    gripper_open: (T, A), as measured, or else as last commanded.
    action: (T, A, 6), commanded displacement of each step, translation and rotation vector; or None.
    gripper_command: (T, A). joints: (T, A, J) for datasets that tell joints only, else None.
    """

    instruction: str
    pose: np.ndarray | None
    gripper_open: np.ndarray
    action: np.ndarray | None
    gripper_command: np.ndarray
    joints: np.ndarray | None = None

    @property
    def num_steps(self) -> int:
        """T, the steps that are used."""
        return len(self.gripper_command)

    @property
    def num_arms(self) -> int:
        """A, the arms of the robot."""
        return self.gripper_command.shape[1]


def displacement(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """What leads from poses (..., 7) to poses (..., 7), in the base frame: (..., 6), metres and rotation vector."""
    shape = start.shape[:-1]
    first, last = (Rotation.from_quat(x[..., 3:].reshape(-1, 4)) for x in (start, end))
    turned = (last * first.inv()).as_rotvec().reshape(*shape, 3)
    return np.concatenate([end[..., :3] - start[..., :3], turned], axis=-1)
