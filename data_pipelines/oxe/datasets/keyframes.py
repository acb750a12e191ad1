"""Demonstrations of this project as RLDS builds, which `data_pipelines.rlds.export` writes."""

from data_pipelines.oxe.columns import Openness, Pose, Read
from data_pipelines.oxe.dataset import ArmColumns, OxeDataset

_SOURCE = "python -m data_pipelines.rlds.export"
_NOTES = ("steps are keyframes: each one's action is the next, whatever the horizon", "poses are in the world frame")


def _arm(first: int) -> ArmColumns:
    """Of an arm whose eight numbers begin at this column: position, quaternion xyzw, openness."""
    pose, gripper = slice(first, first + 7), slice(first + 7, first + 8)
    return ArmColumns(
        gripper=Openness(Read("action", gripper.start, gripper.stop), 0, 1),
        pose=Pose(Read("observation/state", pose.start, pose.stop), "xyzw"),
        gripper_state=Openness(Read("observation/state", gripper.start, gripper.stop), 0, 1),
        keyframe=Pose(Read("action", pose.start, pose.stop), "xyzw"),
    )


DATASETS = (
    OxeDataset("keyframes_one_arm", 1, _SOURCE, {"primary": "image"}, (_arm(0),), notes=_NOTES),
    OxeDataset("keyframes_two_arms", 1, _SOURCE, {"primary": "image"}, (_arm(0), _arm(8)), notes=_NOTES),
)
