"""Datasets of the University of Tokyo: PR2, xArm with one and two arms, and LSMO."""

from data_pipelines.oxe.columns import Following, Openness, Pose, Read
from data_pipelines.oxe.dataset import ArmColumns, OxeDataset
from data_pipelines.oxe.layouts import (
    IMAGE,
    OPENING_DOUBTED,
    SUFFIX,
    UNCLEAR_ACTION,
    closing,
    converted,
    opening,
    reached,
)


def _pr2(name: str) -> OxeDataset:
    measured = Openness(Read("observation/state", 6, 7), 0, 86)
    notes = (
        "positions and the gripper's width are millimetres, as thu-ml/RoboticsDiffusionTransformer reads them",
        "which way the gripper's action goes is not recorded: the opening of the next step is the command",
    )
    return reached(name, 10, "rpy", gripper=Following(measured), gripper_state=measured, scale=1e-3, notes=notes)


DATASETS = (
    _pr2(f"utokyo_pr2_opening_fridge{SUFFIX}"),
    _pr2(f"utokyo_pr2_tabletop_manipulation{SUFFIX}"),
    reached(
        f"utokyo_xarm_pick_and_place{SUFFIX}",
        10,
        "ypr",
        images={"primary": "image", "secondary": "image2", "wrist": "hand_image"},
        gripper=closing(7),
        state="observation/end_effector_pose",
        notes=(
            "angles come as yaw, pitch, roll",
            "the gripper's action is the trigger of the controller (frt03/rlds_dataset_builder), which closes: octo and"
            " openvla keep it the wrong way round",
        ),
    ),
    converted(
        f"utokyo_xarm_bimanual{SUFFIX}",
        10,
        IMAGE,
        ArmColumns(gripper=opening(6), pose=Pose(Read("observation/pose_l"), "ypr")),
        ArmColumns(gripper=opening(13), pose=Pose(Read("observation/pose_r"), "ypr")),
        notes=(
            UNCLEAR_ACTION,
            "two arms, left first: octo and openvla throw the left one away",
            "angles come as yaw, pitch, roll",
            OPENING_DOUBTED,
        ),
    ),
    reached(
        f"tokyo_u_lsmo{SUFFIX}",
        10,
        "rpy",
        notes=("unsure: the measured gripper is always 0, which thu-ml/RoboticsDiffusionTransformer takes for open",),
    ),
)
