"""UIUC's D3Field."""

from data_pipelines.oxe.columns import Constant, Delta, Pose, Read
from data_pipelines.oxe.dataset import ArmColumns
from data_pipelines.oxe.layouts import converted

DATASETS = (
    converted(
        "uiuc_d3field",
        1,
        {"primary": "image_1", "secondary": "image_2"},
        ArmColumns(
            gripper=Constant(0.0),
            pose=Pose(Read("observation/state"), "matrix"),
            action=Delta(Read("action"), "none"),
        ),
        notes=("octo and openvla report the data broken", "no gripper is recorded: always closed"),
    ),
)
