"""LIBERO's four suites in simulation, without steps in which nothing happens."""

from data_pipelines.oxe.columns import Delta, Openness, Pose, Read
from data_pipelines.oxe.dataset import ArmColumns, OxeDataset, View


def _libero(suite: str) -> OxeDataset:
    arm = ArmColumns(
        gripper=Openness(Read("action", 6, 7), 1, 0),
        pose=Pose(Read("observation/state", 0, 6), "rotvec"),
        action=Delta(Read("action", 0, 6), "rotvec", 0.05, 0.5),
        gripper_state=Openness(Read("observation/state", 6, 7), 0, 0.04),
    )
    notes = (
        "the state's rotation is axis-angle (robosuite), which openvla tags roll-pitch-yaw",
        "a unit of action is 5 cm or 0.5 rad (robosuite's OSC_POSE)",
        "the gripper's -1 is open and +1 closed; pictures are stored upright",
    )
    source = "https://huggingface.co/datasets/openvla/modified_libero_rlds"
    images: dict[View, str] = {"primary": "image", "wrist": "wrist_image"}
    return OxeDataset(f"libero_{suite}_no_noops", 20, source, images, (arm,), notes=notes)


DATASETS = (*map(_libero, ("spatial", "object", "goal", "10")),)
