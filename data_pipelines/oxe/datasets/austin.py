"""Datasets of UT Austin: VIOLA, BUDS, MUTEX, SAILOR and Sirius."""

from typing import Unpack

from data_pipelines.oxe.columns import Delta, Openness, Pose, Read
from data_pipelines.oxe.dataset import ArmColumns, OxeDataset
from data_pipelines.oxe.layouts import (
    BUCKET,
    CLOSING_ACTION,
    EXCHANGED,
    EXCHANGED_VIEWS,
    FRANKA_WIDTH,
    IMAGE_AND_WRIST,
    LANGUAGE,
    SCALED,
    SUFFIX,
    Options,
    closing,
    converted,
    moved,
)


def _state_matrix(name: str, hz: float, *further: str, **options: Unpack[Options]) -> OxeDataset:
    """7 joints, the gripper's width and the hand's 4 x 4 pose as state (VIOLA's and LIBERO's robot stack)."""
    arm = ArmColumns(
        gripper=closing(7),
        pose=Pose(Read("observation/state", 8, 24), "matrix"),
        action=Delta(Read("action", 0, 6), "rpy"),
        gripper_state=Openness(Read("observation/state", 7, 8), 0, FRANKA_WIDTH),
    )
    notes = ("the state's last 16 columns are the hand's pose, which octo and openvla leave unread", SCALED)
    return converted(name, hz, IMAGE_AND_WRIST, arm, notes=(*notes, *further), **options)


DATASETS = (
    OxeDataset(
        "viola",
        20,
        f"{BUCKET}/viola/0.1.0",
        {"primary": "agentview_rgb", "wrist": "eye_in_hand_rgb"},
        (
            ArmColumns(
                gripper=Openness(CLOSING_ACTION, 1, 0),
                pose=Pose(Read("observation/ee_states"), "matrix"),
                action=moved(),
                gripper_state=Openness(Read("observation/gripper_states"), 0, FRANKA_WIDTH),
            ),
        ),
        LANGUAGE,
        notes=(
            "ee_states is the hand's 4 x 4 pose, which octo and openvla leave unread",
            "actions are scaled to -1..1: only reached poses are metric",
        ),
    ),
    _state_matrix(f"austin_buds_dataset{SUFFIX}", 20),
    _state_matrix("utaustin_mutex", 20, EXCHANGED, bgr=EXCHANGED_VIEWS),
    converted(
        f"austin_sailor_dataset{SUFFIX}",
        20,
        IMAGE_AND_WRIST,
        ArmColumns(
            gripper=closing(7),
            pose=Pose(Read("observation/state", 0, 7), "xyzw"),
            action=Delta(Read("action", 0, 6), "rpy"),
            gripper_state=Openness(Read("observation/state_gripper"), 0, 0.077),
        ),
        notes=(SCALED,),
    ),
    converted(
        f"austin_sirius_dataset{SUFFIX}",
        20,
        IMAGE_AND_WRIST,
        ArmColumns(
            gripper=closing(7),
            pose=Pose(Read("observation/state_ee"), "matrix"),
            action=Delta(Read("action", 0, 6), "rpy"),
            gripper_state=Openness(Read("observation/state_gripper"), 0, 0.077),
        ),
        notes=("`state` is joints, which octo and openvla take for a pose: state_ee is the pose", SCALED),
    ),
)
