"""ALOHA: two arms, static and mobile."""

from data_pipelines.oxe.columns import Openness, Read
from data_pipelines.oxe.dataset import ArmColumns, OxeDataset, View
from data_pipelines.oxe.layouts import BUCKET, JOINTS_ONLY


def _aloha(name: str, source: str, images: dict[View, str], *notes: str) -> OxeDataset:
    arms = tuple(
        ArmColumns(
            gripper=Openness(Read("action", start + 6, start + 7), 0, 1),
            joints=Read("observation/state", start, start + 6),
            gripper_state=Openness(Read("observation/state", start + 6, start + 7), 0, 1),
        )
        for start in (0, 7)
    )
    every = "50 Hz: every fifth step is kept, as octo does"
    return OxeDataset(name, 50, source, images, arms, encoding="joints", stride=5, notes=(JOINTS_ONLY, every, *notes))


DATASETS = (
    _aloha(
        "aloha_static_dataset",
        "https://tonyzhaozh.github.io/aloha",
        {"primary": "cam_high", "secondary": "cam_low", "wrist": "cam_right_wrist"},
    ),
    _aloha(
        "aloha_dagger_dataset",
        "https://tonyzhaozh.github.io/aloha",
        {"primary": "cam_high", "secondary": "cam_low", "wrist": "cam_right_wrist"},
    ),
    _aloha(
        "aloha_mobile_dataset",
        f"{BUCKET}/aloha_mobile/0.0.1",
        {"primary": "cam_high", "wrist": "cam_right_wrist"},
        "the base's two last columns are left out",
    ),
)
