"""Datasets of Stanford: RoboTurk, Kuka multimodal, HYDRA, MaskViT and RoboCook."""

from data_pipelines.oxe.columns import Delta, Following, Join, Openness, Pose, Read
from data_pipelines.oxe.dataset import ArmColumns, OxeDataset
from data_pipelines.oxe.layouts import (
    BUCKET,
    CLOSING_ACTION,
    EXCHANGED,
    EXCHANGED_VIEWS,
    FRANKA_WIDTH,
    IMAGE,
    IMAGE_AND_WRIST,
    LANGUAGE,
    QUATERNION_DOUBTED,
    SUFFIX,
    closing,
    converted,
    moved,
    opening,
)

_ROBOCOOK_WIDTH = Openness(Read("observation/state", 6, 7), 0, FRANKA_WIDTH)

DATASETS = (
    OxeDataset(
        "roboturk",
        10,
        f"{BUCKET}/roboturk/0.1.0",
        {"primary": "front_rgb"},
        (ArmColumns(gripper=Openness(CLOSING_ACTION, 1, 0), action=moved()),),
        LANGUAGE,
        metric=False,
        notes=("no robot state; the units of actions are not recorded",),
    ),
    converted(
        f"stanford_kuka_multimodal_dataset{SUFFIX}",
        20,
        IMAGE,
        ArmColumns(
            gripper=opening(3),
            pose=Pose(Join(Read("observation/ee_position"), Read("observation/ee_orientation")), "xyzw"),
            action=Delta(Read("action", 0, 3), "none"),
        ),
        notes=("the peg is held throughout", "depth comes without a camera", QUATERNION_DOUBTED),
    ),
    converted(
        f"stanford_hydra_dataset{SUFFIX}",
        10,
        IMAGE_AND_WRIST,
        ArmColumns(
            gripper=closing(7),
            pose=Pose(Join(Read("observation/state", 0, 3), Read("observation/state", 7, 10)), "rpy"),
            action=Delta(Read("action", 0, 6), "rpy"),
        ),
        bgr=EXCHANGED_VIEWS,
        notes=(
            "which of three gripper columns is the opening is not recorded: the last command stands for it",
            EXCHANGED,
        ),
    ),
    converted(
        f"stanford_mask_vit{SUFFIX}",
        1,
        IMAGE,
        ArmColumns(
            gripper=Openness(Read("action", 4, 5), 1, -1),
            pose=Pose(Read("observation/end_effector_pose", 0, 4), "yaw"),
            action=Delta(Read("action", 0, 4), "yaw"),
        ),
        metric=False,
        notes=(
            "the fourth column is yaw; octo and openvla put it where roll belongs",
            "-1 opens and 1 closes: octo and openvla keep it the wrong way round",
        ),
    ),
    converted(
        f"stanford_robocook{SUFFIX}",
        5,
        {"primary": "image_1", "secondary": "image_2"},
        ArmColumns(
            gripper=Following(_ROBOCOOK_WIDTH),
            pose=Pose(Read("observation/state", 0, 6), "rpy"),
            action=Delta(Read("action", 0, 6), "rotvec", 1 / 5, 1 / 5),
            gripper_state=_ROBOCOOK_WIDTH,
        ),
        notes=(
            "actions are velocities: divided by the frequency",
            "the gripper's action is a velocity too: the opening of the next step is the command",
            "depth and extrinsics come without intrinsics",
        ),
    ),
)
