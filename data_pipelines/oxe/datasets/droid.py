"""DROID, its part about wiping, and OpenVLA's finetuning sets in DROID's setup (TDROID)."""

from data_pipelines.oxe.columns import Delta, Openness, Pose, Read, Settled
from data_pipelines.oxe.dataset import ArmColumns, OxeDataset, View


def _tdroid(task: str) -> OxeDataset:
    arm = ArmColumns(
        gripper=Settled(Read("action", 6, 7)),
        pose=Pose(Read("observation/cartesian_position", 0, 6), "rpy"),
        action=Delta(Read("action", 0, 6), "rpy"),
        gripper_state=Openness(Read("observation/gripper_position", -1), 1, 0),
    )
    source = "https://github.com/openvla/openvla"
    notes = ("a small set for finetuning", "DROID's gripper position is 1 when closed")
    return OxeDataset(f"tdroid_{task}", 5, source, {"primary": "static_image"}, (arm,), metric=True, notes=notes)


def _droid(name: str, primary: str, secondary: str | None, source: str) -> OxeDataset:
    images: dict[View, str] = {"primary": primary, "wrist": "wrist_image_left"}
    if secondary:
        images["secondary"] = secondary
    arm = ArmColumns(
        gripper=Openness(Read("action_dict/gripper_position"), 1, 0),
        pose=Pose(Read("observation/cartesian_position"), "rpy"),
        action=Delta(Read("action_dict/cartesian_velocity"), "rpy"),
        gripper_state=Openness(Read("observation/gripper_position"), 1, 0),
    )
    notes = (
        "the gripper's position is 1 when closed",
        "cartesian_velocity is scaled to -1..1: only reached poses are metric",
        "octo's registry tags the state a quaternion; it is roll, pitch, yaw",
        "language_instruction_2 and _3 are other words for the same episode; the first is used",
    )
    return OxeDataset(name, 15, source, images, (arm,), notes=notes)


DATASETS = (
    _droid("droid", "exterior_image_1_left", "exterior_image_2_left", "gs://gresearch/robotics/droid/1.0.0"),
    _droid("droid_wipe", "exterior_image_2_left", None, "https://github.com/openvla/openvla"),
    *map(
        _tdroid,
        (
            "carrot_in_bowl",
            "pour_corn_in_pot",
            "flip_pot_upright",
            "move_object_onto_plate",
            "knock_object_over",
            "cover_object_with_towel",
        ),
    ),
)
