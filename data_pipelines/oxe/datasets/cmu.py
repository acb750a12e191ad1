"""Datasets of CMU: exploration, pick-up and insertion, food, Play Fusion, Stretch and RoboSet."""

from data_pipelines.oxe.columns import Delta, Openness, Pose, Preceding, Read
from data_pipelines.oxe.dataset import ArmColumns, OxeDataset
from data_pipelines.oxe.layouts import (
    BUCKET,
    EXCHANGED,
    EXCHANGED_VIEWS,
    IMAGE,
    IMAGE_AND_WRIST,
    JOINTS_ONLY,
    QUATERNION_DOUBTED,
    SUFFIX,
    converted,
    opening,
)

DATASETS = (
    converted(
        f"cmu_franka_exploration_dataset{SUFFIX}",
        10,
        {"primary": "highres_image"},
        ArmColumns(gripper=opening(6), action=Delta(Read("action", 0, 3), "none")),
        metric=False,
        notes=(
            "no robot state; the units of actions are not recorded",
            "the angles are differences of z-y-z angles (russellmendonca/rlds_dataset_builder), from which no rotation"
            " can be told: they are left out",
            "the last column is a flag",
        ),
    ),
    converted(
        f"iamlab_cmu_pickup_insert{SUFFIX}",
        20,
        IMAGE_AND_WRIST,
        ArmColumns(
            gripper=opening(7),
            pose=Pose(Preceding(Read("action", 0, 7)), "wxyz"),
            gripper_state=Openness(Read("observation/state", 7, 8), 0, 1),
        ),
        first=1,
        notes=(
            "the action is the pose reached one step later (mohitsharma0690/rlds_dataset_builder): it stands for the"
            " pose of the next step, since the state is joints only",
            "the quaternion's real part is first; octo and openvla take it for the last",
        ),
    ),
    converted(
        "cmu_playing_with_food",
        10,
        {"primary": "image", "wrist": "finger_vision_1"},
        ArmColumns(gripper=Openness(Read("action", -1), 0, 1), pose=Pose(Read("action", 0, 7), "wxyz")),
        bgr=EXCHANGED_VIEWS,
        notes=(
            "the action is a pose, its quaternion's real part first (firephinx/rlds_dataset_builder): it stands for the"
            " pose, since the state is forces only; the hand never turns",
            "grasps and releases tell one pose for the whole episode, so that only presses move",
            EXCHANGED,
        ),
    ),
    converted(
        "cmu_play_fusion",
        5,
        IMAGE,
        ArmColumns(
            gripper=opening(7),
            action=Delta(Read("action", 0, 7), "xyzw"),
            gripper_state=Openness(Read("observation/state", 7, 8), 0, 0.085),
        ),
        metric=False,
        notes=(
            "the rotation is a quaternion; octo and openvla take its tail, the gripper and a flag for rotation",
            QUATERNION_DOUBTED,
            "the gripper's state is its width, up to 85 mm as thu-ml/RoboticsDiffusionTransformer has it",
        ),
    ),
    converted(
        "cmu_stretch",
        10,
        IMAGE,
        ArmColumns(
            gripper=opening(6),
            pose=Pose(Read("observation/state", 0, 3), "none"),
            action=Delta(Read("action", 0, 6), "rpy"),
            gripper_state=Openness(Read("observation/state", 3, 4), 0, 1),
        ),
        notes=("the state has no rotation",),
    ),
    OxeDataset(
        "roboset",
        5,
        f"{BUCKET}/robo_set/0.0.1",
        {"primary": "image_left", "secondary": "image_right", "wrist": "image_wrist"},
        (
            ArmColumns(
                gripper=Openness(Read("action", 7, 8), 1, 0),
                joints=Read("observation/state", 0, 7),
                gripper_state=Openness(Read("observation/state", 7, 8), 1, 0),
            ),
        ),
        encoding="joints",
        notes=(JOINTS_ONLY, "tfds calls it robo_set"),
    ),
)
