"""TOTO: a Franka that scoops and pours."""

from data_pipelines.oxe.columns import Openness, Read
from data_pipelines.oxe.dataset import ArmColumns, OxeDataset
from data_pipelines.oxe.layouts import BUCKET, LANGUAGE, moved

DATASETS = (
    OxeDataset(
        "toto",
        30,
        f"{BUCKET}/toto/0.1.0",
        {"primary": "image"},
        (ArmColumns(gripper=Openness(Read("action/open_gripper"), 0, 1), action=moved()),),
        LANGUAGE,
        metric=False,
        notes=("the state is joints only; the units of actions are not recorded",),
    ),
)
