"""JACO Play: a Kinova arm at a table."""

from data_pipelines.oxe.columns import Delta, Pose, Read, RelativeClosing
from data_pipelines.oxe.dataset import ArmColumns, OxeDataset
from data_pipelines.oxe.layouts import BUCKET, CLOSING_ACTION, LANGUAGE, WORLD_VECTOR

DATASETS = (
    OxeDataset(
        "jaco_play",
        10,
        f"{BUCKET}/jaco_play/0.1.0",
        {"primary": "image", "wrist": "image_wrist"},
        (
            ArmColumns(
                gripper=RelativeClosing(CLOSING_ACTION),
                pose=Pose(Read("observation/end_effector_cartesian_pos", 0, 3), "none"),
                action=Delta(WORLD_VECTOR, "none"),
            ),
        ),
        LANGUAGE,
        notes=("the hand never turns, and its 4 further pose columns are undocumented: the rotation is the identity",),
    ),
)
