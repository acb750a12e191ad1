"""Datasets of UC Berkeley: cable routing, AUTOLab's UR5, MVP, RPT, Fanuc and FMB. Bridge and GNM are elsewhere."""

from data_pipelines.oxe.columns import Constant, Delta, Following, Openness, Pose, Read, RelativeClosing
from data_pipelines.oxe.dataset import ArmColumns, OxeDataset
from data_pipelines.oxe.layouts import (
    BUCKET,
    CLOSING_ACTION,
    EXCHANGED,
    EXCHANGED_VIEWS,
    IMAGE_AND_WRIST,
    LANGUAGE,
    QUATERNION_DOUBTED,
    SUFFIX,
    converted,
    moved,
)

DATASETS = (
    OxeDataset(
        "berkeley_cable_routing",
        10,
        f"{BUCKET}/berkeley_cable_routing/0.1.0",
        {"primary": "image", "secondary": "top_image", "wrist": "wrist45_image"},
        (ArmColumns(gripper=Constant(0.0), action=moved(10)),),
        LANGUAGE,
        notes=("actions are velocities: divided by the frequency", "the gripper holds the cable: always closed"),
    ),
    OxeDataset(
        "berkeley_autolab_ur5",
        5,
        f"{BUCKET}/berkeley_autolab_ur5/0.1.0",
        {"primary": "image", "wrist": "hand_image"},
        (
            ArmColumns(
                gripper=RelativeClosing(CLOSING_ACTION),
                pose=Pose(Read("observation/robot_state", 6, 13), "xyzw"),
                action=moved(),
                gripper_state=Openness(Read("observation/robot_state", 13, 14), 1, 0),
            ),
        ),
        LANGUAGE,
        bgr=("wrist",),
        notes=(
            "the gripper's action is a change: it holds until the next one",
            "depth comes without a camera",
            "red and blue are exchanged in the wrist's pictures",
        ),
    ),
    converted(
        f"berkeley_mvp{SUFFIX}",
        5,
        {"wrist": "hand_image"},
        ArmColumns(
            gripper=Openness(Read("action", 7, 8), 1, 0),
            pose=Pose(Read("observation/pose"), "xyzw"),
            gripper_state=Openness(Read("observation/gripper"), 1, 0),
        ),
        notes=("actions are joints: displacements come from reached poses", "wrist camera only"),
    ),
    converted(
        f"berkeley_rpt{SUFFIX}",
        30,
        {"wrist": "hand_image"},
        ArmColumns(
            gripper=Openness(Read("action", 7, 8), 1, 0),
            joints=Read("observation/joint_pos"),
            gripper_state=Openness(Read("observation/gripper"), 1, 0),
        ),
        encoding="joints",
        stride=3,
        notes=(
            "joints only, no pose of the hand",
            "30 Hz: every third step is kept, as octo does",
            "wrist camera only",
        ),
    ),
    converted(
        "berkeley_fanuc_manipulation",
        10,
        IMAGE_AND_WRIST,
        ArmColumns(
            gripper=Following(Openness(Read("observation/state", 6, 7), 1, 0)),
            pose=Pose(Read("observation/end_effector_state"), "xyzw"),
            action=Delta(Read("action"), "rpy"),
            gripper_state=Openness(Read("observation/state", 6, 7), 1, 0),
        ),
        bgr=EXCHANGED_VIEWS,
        notes=(
            "no gripper action: the next state stands for it, 1 being closed as octo and openvla have it",
            "end_effector_state is the pose, which octo and openvla leave unread",
            QUATERNION_DOUBTED,
            EXCHANGED,
        ),
    ),
    OxeDataset(
        "fmb_dataset",
        10,
        f"{BUCKET}/fmb/0.0.1",
        {"primary": "image_side_1", "secondary": "image_side_2", "wrist": "image_wrist_1"},
        (
            ArmColumns(
                gripper=Following(Openness(Read("observation/state_gripper_pose"), 1, 0)),
                pose=Pose(Read("observation/eef_pose"), "xyzw"),
                action=Delta(Read("action", 0, 6), "rpy"),
                gripper_state=Openness(Read("observation/state_gripper_pose"), 1, 0),
            ),
        ),
        notes=(
            "the gripper's state is 1 when closed (https://huggingface.co/datasets/robot-lev/fmb_multi, and"
            " thu-ml/RoboticsDiffusionTransformer); which way its action goes is not recorded: the next state is the"
            " command",
            "only reached poses are known to be metric",
            "depth comes without a camera",
            "tfds calls it fmb",
        ),
    ),
)
