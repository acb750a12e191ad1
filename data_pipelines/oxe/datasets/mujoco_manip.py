"""Octo's simulated MuJoCo data."""

from data_pipelines.oxe.columns import Delta, Openness, Read
from data_pipelines.oxe.dataset import ArmColumns, OxeDataset

DATASETS = (
    OxeDataset(
        "mujoco_manip",
        10,
        "https://github.com/octo-models/octo",
        {"primary": "image"},
        (
            ArmColumns(
                gripper=Openness(Read("action", 6, 7), 255, 0),
                action=Delta(Read("action", 0, 6), "rpy"),
            ),
        ),
        metric=False,
        notes=("simulation; the gripper's command is 0 to 255 for closed", "the layout of its state is not published"),
    ),
)
