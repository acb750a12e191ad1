"""Navigation, joints, and what was added or made elsewhere: ALOHA, DROID, LIBERO, FMB, Dobb-E, RoboSet, TDROID.

Facts: each dataset's page of https://www.tensorflow.org/datasets/catalog where there is one; the projects named as
source; octo's and openvla's ``oxe/transforms``.
"""

import numpy as np

from data_pipelines.oxe.dataset import OxeDataset, View
from data_pipelines.oxe.motion import (
    Arm,
    Column,
    constant,
    delta,
    following,
    in_base,
    join,
    openness,
    pose,
    read,
    settled,
)

BUCKET = "gs://gresearch/robotics"
_NAVIGATION = ("navigation: left out of every mixture here",)
_JOINTS = "joints only, no pose of the hand: this model cannot learn from it"


def _gnm(name: str, hz: float) -> OxeDataset:
    arm = Arm(
        gripper=constant(0.0),
        pose=_flat(join(read("observation/position"), read("observation/yaw"))),
        action=delta(read("action"), "none"),
    )
    source = f"{BUCKET}/{name}/0.1.0"
    return OxeDataset(name, hz, source, {"wrist": "image"}, (arm,), encoding="navigation", notes=_NAVIGATION)


def _flat(column: Column) -> Column:
    """x, y and yaw as a pose of height 0."""
    return pose(lambda episode: _with_height(column(episode)), "yaw")


def _with_height(values: np.ndarray) -> np.ndarray:
    return np.concatenate([values[:, :2], np.zeros((len(values), 1)), values[:, 2:3]], axis=1)


def _aloha(name: str, source: str, images: dict[View, str], *notes: str) -> OxeDataset:
    arms = tuple(
        Arm(
            gripper=openness(read("action", start + 6, start + 7), 0, 1),
            joints=read("observation/state", start, start + 6),
            gripper_state=openness(read("observation/state", start + 6, start + 7), 0, 1),
        )
        for start in (0, 7)
    )
    every = "50 Hz: every fifth step is kept, as octo does"
    return OxeDataset(name, 50, source, images, arms, encoding="joints", stride=5, notes=(_JOINTS, every, *notes))


def _tdroid(task: str) -> OxeDataset:
    arm = Arm(
        gripper=settled(read("action", 6, 7)),
        pose=pose(read("observation/cartesian_position", 0, 6), "rpy"),
        action=delta(read("action", 0, 6), "rpy"),
        gripper_state=openness(read("observation/gripper_position", -1), 1, 0),
    )
    source = "https://github.com/openvla/openvla"
    notes = ("a small set for finetuning", "DROID's gripper position is 1 when closed")
    return OxeDataset(f"tdroid_{task}", 5, source, {"primary": "static_image"}, (arm,), metric=True, notes=notes)


def _droid(name: str, primary: str, secondary: str | None, source: str) -> OxeDataset:
    images: dict[View, str] = {"primary": primary, "wrist": "wrist_image_left"}
    if secondary:
        images["secondary"] = secondary
    arm = Arm(
        gripper=openness(read("action_dict/gripper_position"), 1, 0),
        pose=pose(read("observation/cartesian_position"), "rpy"),
        action=delta(read("action_dict/cartesian_velocity"), "rpy"),
        gripper_state=openness(read("observation/gripper_position"), 1, 0),
    )
    notes = (
        "the gripper's position is 1 when closed",
        "cartesian_velocity is scaled to -1..1: only reached poses are metric",
        "octo's registry tags the state a quaternion; it is roll, pitch, yaw",
        "language_instruction_2 and _3 are other words for the same episode; the first is used",
    )
    return OxeDataset(name, 15, source, images, (arm,), notes=notes)


def _libero(suite: str) -> OxeDataset:
    arm = Arm(
        gripper=openness(read("action", 6, 7), 1, 0),
        pose=pose(read("observation/state", 0, 6), "rotvec"),
        action=delta(read("action", 0, 6), "rotvec", 0.05, 0.5),
        gripper_state=openness(read("observation/state", 6, 7), 0, 0.04),
    )
    notes = (
        "the state's rotation is axis-angle (robosuite), which openvla tags roll-pitch-yaw",
        "a unit of action is 5 cm or 0.5 rad (robosuite's OSC_POSE)",
        "the gripper's -1 is open and +1 closed; pictures are stored upright",
    )
    source = "https://huggingface.co/datasets/openvla/modified_libero_rlds"
    images: dict[View, str] = {"primary": "image", "wrist": "wrist_image"}
    return OxeDataset(f"libero_{suite}_no_noops", 20, source, images, (arm,), notes=notes)


_DOBBE_POSE = pose(join(read("observation/xyz"), read("observation/quat")), "xyzw")

DATASETS = [
    OxeDataset(
        "gnm_dataset",
        4,
        "https://sites.google.com/view/drive-any-robot",
        {"primary": "image"},
        (
            Arm(
                gripper=constant(0.0),
                pose=_flat(read("observation/state")),
                action=delta(read("action"), "none"),
            ),
        ),
        encoding="navigation",
        notes=_NAVIGATION,
    ),
    _gnm("berkeley_gnm_recon", 3),
    _gnm("berkeley_gnm_cory_hall", 5),
    _gnm("berkeley_gnm_sac_son", 10),
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
    OxeDataset(
        "fmb_dataset",
        10,
        f"{BUCKET}/fmb/0.0.1",
        {"primary": "image_side_1", "secondary": "image_side_2", "wrist": "image_wrist_1"},
        (
            Arm(
                gripper=following(openness(read("observation/state_gripper_pose"), 1, 0)),
                pose=pose(read("observation/eef_pose"), "xyzw"),
                action=delta(read("action", 0, 6), "rpy"),
                gripper_state=openness(read("observation/state_gripper_pose"), 1, 0),
            ),
        ),
        notes=(
            "the gripper's state is 1 when closed (https://huggingface.co/datasets/robot-lev/fmb_multi, and"
            " thu-ml/RoboticsDiffusionTransformer); which way its action goes is not told: the next state is the"
            " command",
            "only reached poses are known to be metric",
            "depth comes without a camera",
            "tfds calls it fmb",
        ),
    ),
    OxeDataset(
        "dobbe",
        30,
        f"{BUCKET}/dobbe/0.0.1",
        {"wrist": "wrist_image"},
        (
            Arm(
                gripper=openness(read("action", 6, 7), 0, 1),
                pose=_DOBBE_POSE,
                action=in_base(delta(read("action", 0, 6), "rpy"), _DOBBE_POSE, translation=False),
                gripper_state=openness(read("observation/gripper"), 0, 1),
            ),
        ),
        notes=(
            "wrist camera only; openvla uses it as the primary view",
            "the rotation of an action is in the tool's frame, its translation is not",
            "every frame of the 30 Hz videos is a step (SudeepDasari/dobbe_rlds_dataset_builder); Dobb-E's policies run"
            " at 3.75 Hz",
        ),
    ),
    OxeDataset(
        "roboset",
        5,
        f"{BUCKET}/robo_set/0.0.1",
        {"primary": "image_left", "secondary": "image_right", "wrist": "image_wrist"},
        (
            Arm(
                gripper=openness(read("action", 7, 8), 1, 0),
                joints=read("observation/state", 0, 7),
                gripper_state=openness(read("observation/state", 7, 8), 1, 0),
            ),
        ),
        encoding="joints",
        notes=(_JOINTS, "tfds calls it robo_set"),
    ),
    OxeDataset(
        "mujoco_manip",
        10,
        "https://github.com/octo-models/octo",
        {"primary": "image"},
        (
            Arm(
                gripper=openness(read("action", 6, 7), 255, 0),
                action=delta(read("action", 0, 6), "rpy"),
            ),
        ),
        metric=False,
        notes=("simulation; the gripper's command is 0 to 255 for closed", "the layout of its state is not published"),
    ),
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
    *map(_libero, ("spatial", "object", "goal", "10")),
]
