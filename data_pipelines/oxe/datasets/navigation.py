"""Navigation data of GNM: left out of every mixture."""

import dataclasses

import numpy as np

from data_pipelines.oxe.columns import Column, Constant, Delta, Join, Pose, Read
from data_pipelines.oxe.dataset import ArmColumns, OxeDataset
from data_pipelines.oxe.layouts import BUCKET
from data_pipelines.rlds.features import RldsEpisode

_NAVIGATION = ("navigation: left out of every mixture here",)


@dataclasses.dataclass(frozen=True)
class _AtHeightZero:
    """x, y and yaw (T, 3) as x, y, 0 and yaw (T, 4)."""

    column: Column

    def __call__(self, episode: RldsEpisode) -> np.ndarray:
        values = self.column(episode)
        return np.concatenate([values[:, :2], np.zeros((len(values), 1)), values[:, 2:3]], axis=1)


def _flat(column: Column) -> Column:
    """x, y and yaw as a pose of height 0."""
    return Pose(_AtHeightZero(column), "yaw")


def _gnm(name: str, hz: float) -> OxeDataset:
    arm = ArmColumns(
        gripper=Constant(0.0),
        pose=_flat(Join(Read("observation/position"), Read("observation/yaw"))),
        action=Delta(Read("action"), "none"),
    )
    source = f"{BUCKET}/{name}/0.1.0"
    return OxeDataset(name, hz, source, {"wrist": "image"}, (arm,), encoding="navigation", notes=_NAVIGATION)


DATASETS = (
    OxeDataset(
        "gnm_dataset",
        4,
        "https://sites.google.com/view/drive-any-robot",
        {"primary": "image"},
        (
            ArmColumns(
                gripper=Constant(0.0),
                pose=_flat(Read("observation/state")),
                action=Delta(Read("action"), "none"),
            ),
        ),
        encoding="navigation",
        notes=_NAVIGATION,
    ),
    _gnm("berkeley_gnm_recon", 3),
    _gnm("berkeley_gnm_cory_hall", 5),
    _gnm("berkeley_gnm_sac_son", 10),
)
