"""Datasets of UC San Diego: kitchen, and pick and place."""

import numpy as np

from data_pipelines.oxe.columns import Delta, Following, Openness, Pose, Read
from data_pipelines.oxe.dataset import ArmColumns
from data_pipelines.oxe.layouts import IMAGE, OPENING_DOUBTED, SUFFIX, converted, opening

_FINGER_DISTANCE = Openness(Read("observation/state", 6, 7), 0, 6.03)
"""Its largest value is that of thu-ml/RoboticsDiffusionTransformer."""

DATASETS = (
    converted(
        f"ucsd_kitchen_dataset{SUFFIX}",
        2,
        IMAGE,
        ArmColumns(gripper=opening(6), pose=Pose(Read("action", 0, 6), "rpy", 1e-3, np.pi / 180)),
        notes=(
            "the action is a pose in millimetres and degrees (openvla's published statistics: mean x 410): it stands"
            " for the pose, since the state is joints only",
            OPENING_DOUBTED,
        ),
    ),
    converted(
        f"ucsd_pick_and_place_dataset{SUFFIX}",
        3,
        IMAGE,
        ArmColumns(
            gripper=Following(_FINGER_DISTANCE),
            pose=Pose(Read("observation/state", 0, 6), "rpy", 0.1),
            action=Delta(Read("action", 0, 3), "none"),
            gripper_state=_FINGER_DISTANCE,
        ),
        notes=(
            "positions are decimetres: nicklashansen/rlds_dataset_builder divides the xArm's millimetres by 100",
            "actions are velocities of the hand, which never turns, and a gripper's torque, both scaled to -1..1: only"
            " reached poses are metric, and the fingers' distance of the next step is the command",
        ),
    ),
)
