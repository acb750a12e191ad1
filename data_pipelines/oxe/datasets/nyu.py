"""Datasets of NYU: door opening, ROT, Franka play and Dobb-E."""

from data_pipelines.oxe.columns import Delta, InBase, Join, Openness, Pose, Read, RelativeClosing
from data_pipelines.oxe.dataset import ArmColumns, OxeDataset
from data_pipelines.oxe.layouts import (
    BUCKET,
    CLOSING_ACTION,
    IMAGE,
    LANGUAGE,
    SUFFIX,
    closing,
    converted,
    moved,
    opening,
)

_DOBBE_POSE = Pose(Join(Read("observation/xyz"), Read("observation/quat")), "xyzw")


DATASETS = (
    OxeDataset(
        "nyu_door_opening_surprising_effectiveness",
        3,
        f"{BUCKET}/nyu_door_opening_surprising_effectiveness/0.1.0",
        {"wrist": "image"},
        (ArmColumns(gripper=RelativeClosing(CLOSING_ACTION), action=moved(3)),),
        LANGUAGE,
        notes=("wrist camera only", "actions are velocities: divided by the frequency"),
    ),
    converted(
        f"nyu_rot_dataset{SUFFIX}",
        3,
        IMAGE,
        ArmColumns(
            gripper=closing(7),
            pose=Pose(Read("observation/state", 0, 6), "rpy"),
            action=Delta(Read("action", 0, 6), "rpy"),
            gripper_state=Openness(Read("observation/state", 6, 7), 1, 0),
        ),
        notes=("0 is open and 1 closed, in state and action: octo and openvla keep it the wrong way round",),
    ),
    converted(
        f"nyu_franka_play_dataset{SUFFIX}",
        3,
        {"primary": "image", "secondary": "image_additional_view"},
        ArmColumns(
            gripper=opening(13),
            pose=Pose(Read("observation/state", 7, 13), "rpy"),
            action=Delta(Read("action", 7, 13), "rpy"),
        ),
        notes=("the action starts with 7 joint velocities and ends with a flag", "depth comes without a camera"),
    ),
    OxeDataset(
        "dobbe",
        30,
        f"{BUCKET}/dobbe/0.0.1",
        {"wrist": "wrist_image"},
        (
            ArmColumns(
                gripper=Openness(Read("action", 6, 7), 0, 1),
                pose=_DOBBE_POSE,
                action=InBase(Delta(Read("action", 0, 6), "rpy"), _DOBBE_POSE, translation=False),
                gripper_state=Openness(Read("observation/gripper"), 0, 1),
            ),
        ),
        notes=(
            "wrist camera only; openvla uses it as the primary view",
            "the rotation of an action is in the tool's frame, its translation is not",
            "every frame of the 30 Hz videos is a step (SudeepDasari/dobbe_rlds_dataset_builder); Dobb-E's policies run"
            " at 3.75 Hz",
        ),
    ),
)
