"""Imperial College's Sawyer with a wrist camera."""

from data_pipelines.oxe.columns import Delta, Openness, Read
from data_pipelines.oxe.dataset import ArmColumns
from data_pipelines.oxe.layouts import IMAGE_AND_WRIST, OPENING_DOUBTED, converted, opening

DATASETS = (
    converted(
        "imperialcollege_sawyer_wrist_cam",
        10,
        IMAGE_AND_WRIST,
        ArmColumns(
            gripper=opening(6),
            action=Delta(Read("action", 0, 6), "ypr"),
            gripper_state=Openness(Read("observation/state"), 0, 1),
        ),
        frame="tool",
        notes=(
            "displacements are in the frame of the tool, angles as yaw, pitch, roll",
            "both cameras are the wrist's",
            OPENING_DOUBTED,
        ),
    ),
)
