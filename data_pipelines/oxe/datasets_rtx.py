"""Datasets of Open X-Embodiment's first release that keep actions in named fields, and Bridge.

Facts: the feature descriptions of https://www.tensorflow.org/datasets/catalog (each dataset's page);
https://github.com/octo-models/octo and https://github.com/openvla/openvla (``oxe/transforms``) for what the pages leave
open. Frequencies: the data sheet of https://robotics-transformer-x.github.io. Pictures with red and blue exchanged:
``prepare_open_x.sh`` of https://github.com/kpertsch/rlds_dataset_mod, which octo's and openvla's copies went through.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from data_pipelines.oxe.dataset import OxeDataset, View
from data_pipelines.oxe.motion import (
    FRANKA_WIDTH,
    Arm,
    Column,
    constant,
    delta,
    join,
    openness,
    pose,
    read,
    relative_closing,
    settled,
)
from data_pipelines.rlds.features import RldsEpisode

BUCKET = "gs://gresearch/robotics"
LANGUAGE = "observation/natural_language_instruction"

_VECTOR, _ROTATION = read("action/world_vector"), read("action/rotation_delta")
_CLOSING = read("action/gripper_closedness_action")


def _moved(hz: float | None = None) -> Column:
    """world_vector and rotation_delta; velocities, whose rotation is a vector, where a frequency is given."""
    scale = 1.0 / hz if hz else 1.0
    return delta(join(_VECTOR, _ROTATION), "rotvec" if hz else "rpy", scale, scale)


def _succeeded(episode: RldsEpisode) -> bool:
    return "success" not in episode or bool(episode.column("success"))


_BRIDGE_STATE = pose(read("observation/state", 0, 6), "rpy")
_BRIDGE_NOTES = (
    "the recorded action is what a VR controller asked for: displacements come from reached poses, as in octo",
    "grippers on their way count as the end that they reach",
)


def _bridge(name: str, source: str, first: int) -> OxeDataset:
    arm = Arm(
        gripper=settled(read("action", 6, 7)),
        pose=_BRIDGE_STATE,
        gripper_state=openness(read("observation/state", 6, 7), 0, 1),
    )
    images: dict[View, str] = {"primary": "image_0", "secondary": "image_1"}
    notes = (*_BRIDGE_NOTES, "the copy of the authors' site; the bucket's (bridge_oxe) is an older one")
    return OxeDataset(name, 5, source, images, (arm,), first=first, notes=notes)


DATASETS = [
    OxeDataset(
        "fractal20220817_data",
        3,
        f"{BUCKET}/fractal20220817_data/0.1.0",
        {"primary": "image"},
        (
            Arm(
                gripper=relative_closing(_CLOSING),
                pose=pose(read("observation/base_pose_tool_reached"), "xyzw"),
                action=_moved(),
                gripper_state=openness(read("observation/gripper_closed"), 1, 0),
            ),
        ),
        LANGUAGE,
        notes=("the gripper's action is a change: it holds until the next one", "the base's motion is left out"),
    ),
    OxeDataset(
        "kuka",
        10,
        f"{BUCKET}/kuka/0.1.0",
        {"primary": "image"},
        (
            Arm(
                gripper=relative_closing(_CLOSING),
                pose=pose(read("observation/clip_function_input/base_pose_tool_reached"), "xyzw"),
                action=_moved(),
                gripper_state=openness(read("observation/gripper_closed"), 1, 0),
            ),
        ),
        LANGUAGE,
        keep=_succeeded,
        notes=(
            "self-supervised grasping: only episodes marked as successes are used",
            "states are zlib-compressed tensors: features.json says so, and the reader unpacks them",
            "one instruction for all episodes",
        ),
    ),
    _bridge("bridge_dataset", "https://rail.eecs.berkeley.edu/datasets/bridge_release/data/tfds", 0),
    _bridge("bridge_orig", "https://rail.eecs.berkeley.edu/datasets/bridge_release/data/tfds", 1),
    OxeDataset(
        "bridge_oxe",
        5,
        f"{BUCKET}/bridge/0.1.0",
        {"primary": "image", "secondary": "image_1"},
        (
            Arm(
                gripper=openness(read("action/open_gripper"), 0, 1),
                pose=_BRIDGE_STATE,
                gripper_state=openness(read("observation/state", 6, 7), 0, 1),
            ),
        ),
        LANGUAGE,
        first=1,
        notes=_BRIDGE_NOTES[:1],
    ),
    OxeDataset(
        "taco_play",
        15,
        f"{BUCKET}/taco_play/0.1.0",
        {"primary": "rgb_static", "wrist": "rgb_gripper"},
        (
            Arm(
                gripper=openness(read("action/rel_actions_world", 6, 7), -1, 1),
                pose=pose(read("observation/robot_obs", 0, 6), "rpy"),
                action=delta(read("action/rel_actions_world", 0, 6), "rpy"),
                gripper_state=openness(read("observation/robot_obs", 6, 7), 0, FRANKA_WIDTH),
            ),
        ),
        LANGUAGE,
        notes=(
            "the page says -1 is open; CALVIN, whose format it is, octo and openvla have 1 for open, as here",
            "the gripper's width is column 6 of robot_obs; octo and openvla read column 7, a joint",
            "actions are scaled (CALVIN: about 2 cm and 0.05 rad a unit): only reached poses are metric",
        ),
    ),
    OxeDataset(
        "jaco_play",
        10,
        f"{BUCKET}/jaco_play/0.1.0",
        {"primary": "image", "wrist": "image_wrist"},
        (
            Arm(
                gripper=relative_closing(_CLOSING),
                pose=pose(read("observation/end_effector_cartesian_pos", 0, 3), "none"),
                action=delta(_VECTOR, "none"),
            ),
        ),
        LANGUAGE,
        notes=("the hand never turns, and its 4 further pose columns are undocumented: the rotation is the identity",),
    ),
    OxeDataset(
        "berkeley_cable_routing",
        10,
        f"{BUCKET}/berkeley_cable_routing/0.1.0",
        {"primary": "image", "secondary": "top_image", "wrist": "wrist45_image"},
        (Arm(gripper=constant(0.0), action=_moved(10)),),
        LANGUAGE,
        notes=("actions are velocities: divided by the frequency", "the gripper holds the cable: always closed"),
    ),
    OxeDataset(
        "roboturk",
        10,
        f"{BUCKET}/roboturk/0.1.0",
        {"primary": "front_rgb"},
        (Arm(gripper=openness(_CLOSING, 1, 0), action=_moved()),),
        LANGUAGE,
        metric=False,
        notes=("no robot state; the units of actions are not told",),
    ),
    OxeDataset(
        "nyu_door_opening_surprising_effectiveness",
        3,
        f"{BUCKET}/nyu_door_opening_surprising_effectiveness/0.1.0",
        {"wrist": "image"},
        (Arm(gripper=relative_closing(_CLOSING), action=_moved(3)),),
        LANGUAGE,
        notes=("wrist camera only", "actions are velocities: divided by the frequency"),
    ),
    OxeDataset(
        "viola",
        20,
        f"{BUCKET}/viola/0.1.0",
        {"primary": "agentview_rgb", "wrist": "eye_in_hand_rgb"},
        (
            Arm(
                gripper=openness(_CLOSING, 1, 0),
                pose=pose(read("observation/ee_states"), "matrix"),
                action=_moved(),
                gripper_state=openness(read("observation/gripper_states"), 0, FRANKA_WIDTH),
            ),
        ),
        LANGUAGE,
        notes=(
            "ee_states is the hand's 4 x 4 pose, which octo and openvla leave unread",
            "actions are scaled to -1..1: only reached poses are metric",
        ),
    ),
    OxeDataset(
        "berkeley_autolab_ur5",
        5,
        f"{BUCKET}/berkeley_autolab_ur5/0.1.0",
        {"primary": "image", "wrist": "hand_image"},
        (
            Arm(
                gripper=relative_closing(_CLOSING),
                pose=pose(read("observation/robot_state", 6, 13), "xyzw"),
                action=_moved(),
                gripper_state=openness(read("observation/robot_state", 13, 14), 1, 0),
            ),
        ),
        LANGUAGE,
        bgr=("wrist",),
        notes=(
            "the gripper's action is a change: it holds until the next one",
            "depth comes without a camera",
            "red and blue are exchanged in the wrist's pictures",
        ),
    ),
    OxeDataset(
        "toto",
        30,
        f"{BUCKET}/toto/0.1.0",
        {"primary": "image"},
        (Arm(gripper=openness(read("action/open_gripper"), 0, 1), action=_moved()),),
        LANGUAGE,
        metric=False,
        notes=("the state is joints only; the units of actions are not told",),
    ),
    OxeDataset(
        "language_table",
        10,
        f"{BUCKET}/language_table/0.0.1",
        {"primary": "rgb"},
        (
            Arm(
                gripper=constant(1.0),
                pose=pose(read("observation/effector_translation"), "none"),
                action=delta(read("action"), "none"),
            ),
        ),
        "observation/instruction",
        code_points=True,
        notes=("planar, no gripper: height 0, always open", "the instruction is a row of code points, ended by a zero"),
    ),
    OxeDataset(
        "columbia_cairlab_pusht_real",
        10,
        f"{BUCKET}/columbia_cairlab_pusht_real/0.1.0",
        {"primary": "image", "wrist": "wrist_image"},
        (
            Arm(
                gripper=relative_closing(_CLOSING),
                pose=pose(read("observation/robot_state"), "none"),
                action=_moved(),
            ),
        ),
        LANGUAGE,
        notes=("planar: height 0", "the gripper's action is a change (octo and openvla keep it as it is)"),
    ),
    OxeDataset(
        "bc_z",
        10,
        f"{BUCKET}/bc_z/0.1.0",
        {"primary": "image"},
        (
            Arm(
                gripper=openness(read("action/future/target_close", 0, 1), 1, 0),
                pose=pose(join(read("observation/present/xyz"), read("observation/present/axis_angle")), "rotvec"),
                action=lambda episode: _bc_z_action(episode),
                gripper_state=openness(read("observation/present/sensed_close"), 1, 0.2),
            ),
        ),
        LANGUAGE,
        version="0.1.0",
        notes=(
            "rotations are axis-angle, not roll-pitch-yaw; a residual is added to the axis-angle of the pose",
            "of ten future waypoints the first is the action",
            "sensed_close is 0.2 when open; versions after 0.1.0 are reported broken",
        ),
    ),
    OxeDataset(
        "rh20t",
        10,
        "https://rh20t.github.io",
        {"primary": "image_front", "secondary": "image_side_right", "wrist": "image_wrist"},
        (
            Arm(
                gripper=openness(read("action/gripper"), 0, 1),
                pose=lambda episode: _rh20t_pose(episode),
                gripper_state=openness(read("observation/gripper_width"), 0, 0.1),
            ),
        ),
        notes=(
            "action/tcp_base is a pose, though octo's registry tags it a displacement: reached poses are used",
            "tcp_base of 7 columns has its quaternion's real part first, as in RH20T; of 6, roll-pitch-yaw",
        ),
    ),
]


def _bc_z_action(episode: RldsEpisode) -> np.ndarray:
    """The residual of the first waypoint as a displacement: it is added to the axis-angle, not multiplied."""
    present = read("observation/present/axis_angle")(episode)
    moved = read("action/future/xyz_residual", 0, 3)(episode)
    turned = present + read("action/future/axis_angle_residual", 0, 3)(episode)
    rotation = Rotation.from_rotvec(turned) * Rotation.from_rotvec(present).inv()
    return np.concatenate([moved, rotation.as_rotvec()], axis=1)


def _rh20t_pose(episode: RldsEpisode) -> np.ndarray:
    column = read("observation/tcp_base")
    return pose(column, "wxyz" if column(episode).shape[1] == 7 else "rpy")(episode)
