"""Demonstrations of this project, exported by `data_pipelines.rlds.export`."""

from data_pipelines.oxe.columns import Openness, Pose, Read
from data_pipelines.oxe.dataset import ArmColumns, OxeDataset

_SOURCE = "python -m data_pipelines.rlds.export"
_NOTES = ("each step's action is the next keyframe, so the horizon is ignored", "poses are in the world frame")


def _arm(first: int) -> ArmColumns:
    """Returns the columns of one arm, whose pose starts at column `first` and whose gripper follows it."""
    gripper = first + 7
    return ArmColumns(
        gripper=Openness(Read("action", gripper, gripper + 1), 0, 1),
        pose=Pose(Read("observation/state", first, gripper), "xyzw"),
        gripper_state=Openness(Read("observation/state", gripper, gripper + 1), 0, 1),
        keyframe=Pose(Read("action", first, gripper), "xyzw"),
    )


DATASETS = (
    OxeDataset("keyframes_one_arm", 1, _SOURCE, {"primary": "image"}, (_arm(0),), notes=_NOTES),
    OxeDataset("keyframes_two_arms", 1, _SOURCE, {"primary": "image"}, (_arm(0), _arm(8)), notes=_NOTES),
)
