"""Columbia's Push-T with a real robot."""

from data_pipelines.oxe.columns import Pose, Read, RelativeClosing
from data_pipelines.oxe.dataset import ArmColumns, OxeDataset
from data_pipelines.oxe.layouts import BUCKET, CLOSING_ACTION, LANGUAGE, moved

DATASETS = (
    OxeDataset(
        "columbia_cairlab_pusht_real",
        10,
        f"{BUCKET}/columbia_cairlab_pusht_real/0.1.0",
        {"primary": "image", "wrist": "wrist_image"},
        (
            ArmColumns(
                gripper=RelativeClosing(CLOSING_ACTION),
                pose=Pose(Read("observation/robot_state"), "none"),
                action=moved(),
            ),
        ),
        LANGUAGE,
        notes=("planar: height 0", "the gripper's action is a change (octo and openvla keep it as it is)"),
    ),
)
