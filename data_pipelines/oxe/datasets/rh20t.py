"""RH20T: contact-rich manipulation by several robots."""

import dataclasses

import numpy as np

from data_pipelines.oxe.columns import Openness, Pose, Read
from data_pipelines.oxe.dataset import ArmColumns, OxeDataset
from data_pipelines.rlds.features import RldsEpisode


@dataclasses.dataclass(frozen=True)
class _Rh20tPose:
    """A pose whose rotation is a quaternion or three angles, as its number of columns says."""

    def __call__(self, episode: RldsEpisode) -> np.ndarray:
        column = Read("observation/tcp_base")
        return Pose(column, "wxyz" if column(episode).shape[1] == 7 else "rpy")(episode)


DATASETS = (
    OxeDataset(
        "rh20t",
        10,
        "https://rh20t.github.io",
        {"primary": "image_front", "secondary": "image_side_right", "wrist": "image_wrist"},
        (
            ArmColumns(
                gripper=Openness(Read("action/gripper"), 0, 1),
                pose=_Rh20tPose(),
                gripper_state=Openness(Read("observation/gripper_width"), 0, 0.1),
            ),
        ),
        notes=(
            "action/tcp_base is a pose, though octo's registry tags it a displacement: reached poses are used",
            "tcp_base of 7 columns has its quaternion's real part first, as in RH20T; of 6, roll-pitch-yaw",
        ),
    ),
)
