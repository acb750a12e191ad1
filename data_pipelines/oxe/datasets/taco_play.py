"""TACO Play: a Franka in a toy kitchen, in CALVIN's format."""

from data_pipelines.oxe.columns import Delta, Openness, Pose, Read
from data_pipelines.oxe.dataset import ArmColumns, OxeDataset
from data_pipelines.oxe.layouts import BUCKET, FRANKA_WIDTH, LANGUAGE

DATASETS = (
    OxeDataset(
        "taco_play",
        15,
        f"{BUCKET}/taco_play/0.1.0",
        {"primary": "rgb_static", "wrist": "rgb_gripper"},
        (
            ArmColumns(
                gripper=Openness(Read("action/rel_actions_world", 6, 7), -1, 1),
                pose=Pose(Read("observation/robot_obs", 0, 6), "rpy"),
                action=Delta(Read("action/rel_actions_world", 0, 6), "rpy"),
                gripper_state=Openness(Read("observation/robot_obs", 6, 7), 0, FRANKA_WIDTH),
            ),
        ),
        LANGUAGE,
        notes=(
            "the page says -1 is open; CALVIN, whose format it is, octo and openvla have 1 for open, as here",
            "the gripper's width is column 6 of robot_obs; octo and openvla read column 7, a joint",
            "actions are scaled (CALVIN: about 2 cm and 0.05 rad a unit): only reached poses are metric",
        ),
    ),
)
