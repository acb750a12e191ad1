"""Bridge: a WidowX arm in toy kitchens, as its authors' site and the bucket of Open X-Embodiment have it."""

from data_pipelines.oxe.columns import Openness, Pose, Read, Settled
from data_pipelines.oxe.dataset import ArmColumns, OxeDataset, View
from data_pipelines.oxe.layouts import BUCKET, LANGUAGE

_BRIDGE_STATE = Pose(Read("observation/state", 0, 6), "rpy")
_BRIDGE_NOTES = (
    "the recorded action is what a VR controller asked for: displacements come from reached poses, as in octo",
    "grippers on their way count as the end that they reach",
)


def _bridge(name: str, source: str, first: int) -> OxeDataset:
    arm = ArmColumns(
        gripper=Settled(Read("action", 6, 7)),
        pose=_BRIDGE_STATE,
        gripper_state=Openness(Read("observation/state", 6, 7), 0, 1),
    )
    images: dict[View, str] = {"primary": "image_0", "secondary": "image_1"}
    notes = (*_BRIDGE_NOTES, "the copy of the authors' site; the bucket's (bridge_oxe) is an older one")
    return OxeDataset(name, 5, source, images, (arm,), first=first, notes=notes)


DATASETS = (
    _bridge("bridge_dataset", "https://rail.eecs.berkeley.edu/datasets/bridge_release/data/tfds", 0),
    _bridge("bridge_orig", "https://rail.eecs.berkeley.edu/datasets/bridge_release/data/tfds", 1),
    OxeDataset(
        "bridge_oxe",
        5,
        f"{BUCKET}/bridge/0.1.0",
        {"primary": "image", "secondary": "image_1"},
        (
            ArmColumns(
                gripper=Openness(Read("action/open_gripper"), 0, 1),
                pose=_BRIDGE_STATE,
                gripper_state=Openness(Read("observation/state", 6, 7), 0, 1),
            ),
        ),
        LANGUAGE,
        first=1,
        notes=_BRIDGE_NOTES[:1],
    ),
)
