"""Datasets of Open X-Embodiment that others converted to RLDS: one action vector, one state vector.

Facts: the column descriptions of each dataset's page of https://www.tensorflow.org/datasets/catalog; octo's and
openvla's ``oxe/transforms`` for what the pages leave open. Pictures with red and blue exchanged:
``prepare_open_x.sh`` of https://github.com/kpertsch/rlds_dataset_mod.
"""

import numpy as np

from data_pipelines.oxe.dataset import Depth, OxeDataset, View
from data_pipelines.oxe.motion import (
    FRANKA_WIDTH,
    Arm,
    Column,
    constant,
    delta,
    following,
    in_base,
    join,
    openness,
    pose,
    preceding,
    read,
)
from data_pipelines.rlds.features import RldsEpisode

BUCKET = "gs://gresearch/robotics"
SUFFIX = "_converted_externally_to_rlds"
_SCALED = "actions are scaled to -1..1: only reached poses are metric"
_WRIST: dict[View, str] = {"primary": "image", "wrist": "wrist_image"}
IMAGE: dict[View, str] = {"primary": "image"}
_BGR: tuple[View, ...] = ("primary", "wrist")
OPENING_DOUBTED = "unsure: thu-ml/RoboticsDiffusionTransformer takes 1 for closed, octo and openvla for open, as here"
_QUATERNION_DOUBTED = "unsure: the order of the quaternion is not published"
_EXCHANGED = "red and blue are exchanged in all pictures"


def converted(
    name: str,
    hz: float,
    images: dict[View, str],
    *arms: Arm,
    notes: tuple[str, ...] = (),
    published: str = "0.1.0",
    **options,
) -> OxeDataset:
    """One that is in the bucket under its own name. published: its version there."""
    source = f"{BUCKET}/{name}/{published}"
    return OxeDataset(name, hz, source, images, arms, notes=notes, **options)


def closing(stop: int) -> Column:
    """A command of -1 or 0 for open and 1 for closed in the column before `stop`."""
    return openness(read("action", stop - 1, stop), 1, 0)


def opening(start: int) -> Column:
    """A command of 0 for closed and 1 for open."""
    return openness(read("action", start, start + 1), 0, 1)


def _state_matrix(name: str, hz: float, *further: str, **options) -> OxeDataset:
    """7 joints, the gripper's width and the hand's 4 x 4 pose as state (VIOLA's and LIBERO's robot stack)."""
    arm = Arm(
        gripper=closing(7),
        pose=pose(read("observation/state", 8, 24), "matrix"),
        action=delta(read("action", 0, 6), "rpy"),
        gripper_state=openness(read("observation/state", 7, 8), 0, FRANKA_WIDTH),
    )
    notes = ("the state's last 16 columns are the hand's pose, which octo and openvla leave unread", _SCALED)
    return converted(name, hz, _WRIST, arm, notes=(*notes, *further), **options)


def _finger_distance(episode: RldsEpisode) -> np.ndarray:
    """Its largest value is that of thu-ml/RoboticsDiffusionTransformer."""
    return openness(read("observation/state", 6, 7), 0, 6.03)(episode)


def _velocity_gripper(episode: RldsEpisode) -> np.ndarray:
    return openness(read("observation/state", 6, 7), 0, FRANKA_WIDTH)(episode)


_MANISKILL_POSE = pose(read("observation/tcp_pose"), "wxyz")

DATASETS = [
    converted(
        f"stanford_kuka_multimodal_dataset{SUFFIX}",
        20,
        IMAGE,
        Arm(
            gripper=opening(3),
            pose=pose(join(read("observation/ee_position"), read("observation/ee_orientation")), "xyzw"),
            action=delta(read("action", 0, 3), "none"),
        ),
        notes=("the peg is held throughout", "depth comes without a camera", _QUATERNION_DOUBTED),
    ),
    converted(
        f"nyu_rot_dataset{SUFFIX}",
        3,
        IMAGE,
        Arm(
            gripper=closing(7),
            pose=pose(read("observation/state", 0, 6), "rpy"),
            action=delta(read("action", 0, 6), "rpy"),
            gripper_state=openness(read("observation/state", 6, 7), 1, 0),
        ),
        notes=("0 is open and 1 closed, in state and action: octo and openvla keep it the wrong way round",),
    ),
    converted(
        f"stanford_hydra_dataset{SUFFIX}",
        10,
        _WRIST,
        Arm(
            gripper=closing(7),
            pose=pose(join(read("observation/state", 0, 3), read("observation/state", 7, 10)), "rpy"),
            action=delta(read("action", 0, 6), "rpy"),
        ),
        bgr=_BGR,
        notes=("which of three gripper columns is the opening is not told: the last command stands for it", _EXCHANGED),
    ),
    _state_matrix(f"austin_buds_dataset{SUFFIX}", 20),
    _state_matrix("utaustin_mutex", 20, _EXCHANGED, bgr=_BGR),
    converted(
        f"nyu_franka_play_dataset{SUFFIX}",
        3,
        {"primary": "image", "secondary": "image_additional_view"},
        Arm(
            gripper=opening(13),
            pose=pose(read("observation/state", 7, 13), "rpy"),
            action=delta(read("action", 7, 13), "rpy"),
        ),
        notes=("the action starts with 7 joint velocities and ends with a flag", "depth comes without a camera"),
    ),
    converted(
        f"maniskill_dataset{SUFFIX}",
        20,
        _WRIST,
        Arm(
            gripper=openness(read("action", 6, 7), -1, 1),
            pose=_MANISKILL_POSE,
            action=in_base(delta(read("action", 0, 6), "rotvec", 0.1, 0.1), _MANISKILL_POSE),
            gripper_state=openness(read("observation/state", 7, 8), 0, FRANKA_WIDTH / 2),
        ),
        depth=Depth("depth", 2.0**-10, "main_camera_intrinsic_cv", "main_camera_extrinsic_cv"),
        notes=(
            "the gripper's -1 (closed) to 1 (open) becomes 0 to 1; octo and openvla leave it",
            "rotations are axis-angle, not roll-pitch-yaw; a unit of action is 0.1 m or 0.1 rad",
            "actions are in the tool's frame, the default of ManiSkill2's controller: brought to the world's",
            "quaternions have their real part first; poses are in the simulator's world frame",
            "calibrated depth: the one dataset that can feed the 3D path",
        ),
    ),
    converted(
        f"furniture_bench_dataset{SUFFIX}",
        10,
        _WRIST,
        Arm(
            gripper=closing(8),
            pose=pose(read("observation/state", 0, 7), "xyzw"),
            action=delta(read("action", 0, 7), "xyzw"),
            gripper_state=openness(read("observation/state", 34, 35), 0, FRANKA_WIDTH),
        ),
        notes=("the action's rotation is a quaternion",),
    ),
    converted(
        f"cmu_franka_exploration_dataset{SUFFIX}",
        10,
        {"primary": "highres_image"},
        Arm(gripper=opening(6), action=delta(read("action", 0, 3), "none")),
        metric=False,
        notes=(
            "no robot state; the units of actions are not told",
            "the angles are differences of z-y-z angles (russellmendonca/rlds_dataset_builder), from which no rotation"
            " can be told: they are left out",
            "the last column is a flag",
        ),
    ),
    converted(
        f"ucsd_kitchen_dataset{SUFFIX}",
        2,
        IMAGE,
        Arm(gripper=opening(6), pose=pose(read("action", 0, 6), "rpy", 1e-3, np.pi / 180)),
        notes=(
            "the action is a pose in millimetres and degrees (openvla's published statistics: mean x 410): it stands"
            " for the pose, since the state is joints only",
            OPENING_DOUBTED,
        ),
    ),
    converted(
        f"ucsd_pick_and_place_dataset{SUFFIX}",
        3,
        IMAGE,
        Arm(
            gripper=following(_finger_distance),
            pose=pose(read("observation/state", 0, 6), "rpy", 0.1),
            action=delta(read("action", 0, 3), "none"),
            gripper_state=_finger_distance,
        ),
        notes=(
            "positions are decimetres: nicklashansen/rlds_dataset_builder divides the xArm's millimetres by 100",
            "actions are velocities of the hand, which never turns, and a gripper's torque, both scaled to -1..1: only"
            " reached poses are metric, and the fingers' distance of the next step is the command",
        ),
    ),
    converted(
        f"austin_sailor_dataset{SUFFIX}",
        20,
        _WRIST,
        Arm(
            gripper=closing(7),
            pose=pose(read("observation/state", 0, 7), "xyzw"),
            action=delta(read("action", 0, 6), "rpy"),
            gripper_state=openness(read("observation/state_gripper"), 0, 0.077),
        ),
        notes=(_SCALED,),
    ),
    converted(
        f"austin_sirius_dataset{SUFFIX}",
        20,
        _WRIST,
        Arm(
            gripper=closing(7),
            pose=pose(read("observation/state_ee"), "matrix"),
            action=delta(read("action", 0, 6), "rpy"),
            gripper_state=openness(read("observation/state_gripper"), 0, 0.077),
        ),
        notes=("`state` is joints, which octo and openvla take for a pose: state_ee is the pose", _SCALED),
    ),
    converted(
        "robo_net",
        1,
        {"primary": "image", "secondary": "image1"},
        Arm(
            gripper=closing(5),
            pose=pose(read("observation/state", 0, 4), "yaw"),
            action=delta(read("action", 0, 4), "yaw"),
            gripper_state=openness(read("observation/state", 4, 5), 0, 1),
        ),
        metric=False,
        published="1.0.0",
        notes=(
            "the fourth column is yaw; octo and openvla put it where roll belongs",
            "-1 opens and 1 closes in RoboNet's recorder (SudeepDasari/visual_foresight): octo and openvla keep it the"
            " wrong way round",
            "states are scaled to each robot's workspace",
        ),
    ),
    converted(
        f"berkeley_mvp{SUFFIX}",
        5,
        {"wrist": "hand_image"},
        Arm(
            gripper=openness(read("action", 7, 8), 1, 0),
            pose=pose(read("observation/pose"), "xyzw"),
            gripper_state=openness(read("observation/gripper"), 1, 0),
        ),
        notes=("actions are joints: displacements come from reached poses", "wrist camera only"),
    ),
    converted(
        f"berkeley_rpt{SUFFIX}",
        30,
        {"wrist": "hand_image"},
        Arm(
            gripper=openness(read("action", 7, 8), 1, 0),
            joints=read("observation/joint_pos"),
            gripper_state=openness(read("observation/gripper"), 1, 0),
        ),
        encoding="joints",
        stride=3,
        notes=(
            "joints only, no pose of the hand",
            "30 Hz: every third step is kept, as octo does",
            "wrist camera only",
        ),
    ),
    converted(
        f"kaist_nonprehensile{SUFFIX}",
        10,
        IMAGE,
        Arm(
            gripper=constant(0.0),
            pose=pose(read("observation/state", 14, 21), "xyzw"),
            action=delta(read("action", 0, 6), "rotvec"),
        ),
        notes=("rotations are axis-angle; 14 columns of gains follow", "it pushes with a closed gripper"),
    ),
    converted(
        f"stanford_mask_vit{SUFFIX}",
        1,
        IMAGE,
        Arm(
            gripper=openness(read("action", 4, 5), 1, -1),
            pose=pose(read("observation/end_effector_pose", 0, 4), "yaw"),
            action=delta(read("action", 0, 4), "yaw"),
        ),
        metric=False,
        notes=(
            "the fourth column is yaw; octo and openvla put it where roll belongs",
            "-1 opens and 1 closes: octo and openvla keep it the wrong way round",
        ),
    ),
    converted(
        f"stanford_robocook{SUFFIX}",
        5,
        {"primary": "image_1", "secondary": "image_2"},
        Arm(
            gripper=following(_velocity_gripper),
            pose=pose(read("observation/state", 0, 6), "rpy"),
            action=delta(read("action", 0, 6), "rotvec", 1 / 5, 1 / 5),
            gripper_state=_velocity_gripper,
        ),
        notes=(
            "actions are velocities: divided by the frequency",
            "the gripper's action is a velocity too: the opening of the next step is the command",
            "depth and extrinsics come without intrinsics",
        ),
    ),
    converted(
        "imperialcollege_sawyer_wrist_cam",
        10,
        _WRIST,
        Arm(
            gripper=opening(6),
            action=delta(read("action", 0, 6), "ypr"),
            gripper_state=openness(read("observation/state"), 0, 1),
        ),
        frame="tool",
        notes=(
            "displacements are in the frame of the tool, angles as yaw, pitch, roll",
            "both cameras are the wrist's",
            OPENING_DOUBTED,
        ),
    ),
    converted(
        f"iamlab_cmu_pickup_insert{SUFFIX}",
        20,
        _WRIST,
        Arm(
            gripper=opening(7),
            pose=pose(preceding(read("action", 0, 7)), "wxyz"),
            gripper_state=openness(read("observation/state", 7, 8), 0, 1),
        ),
        first=1,
        notes=(
            "the action is the pose reached one step later (mohitsharma0690/rlds_dataset_builder): it stands for the"
            " pose of the next step, since the state is joints only",
            "the quaternion's real part is first; octo and openvla take it for the last",
        ),
    ),
    converted(
        "uiuc_d3field",
        1,
        {"primary": "image_1", "secondary": "image_2"},
        Arm(
            gripper=constant(0.0),
            pose=pose(read("observation/state"), "matrix"),
            action=delta(read("action"), "none"),
        ),
        notes=("octo and openvla report the data broken", "no gripper is told: always closed"),
    ),
    converted(
        "berkeley_fanuc_manipulation",
        10,
        _WRIST,
        Arm(
            gripper=following(openness(read("observation/state", 6, 7), 1, 0)),
            pose=pose(read("observation/end_effector_state"), "xyzw"),
            action=delta(read("action"), "rpy"),
            gripper_state=openness(read("observation/state", 6, 7), 1, 0),
        ),
        bgr=_BGR,
        notes=(
            "no gripper action: the next state stands for it, 1 being closed as octo and openvla have it",
            "end_effector_state is the pose, which octo and openvla leave unread",
            _QUATERNION_DOUBTED,
            _EXCHANGED,
        ),
    ),
    converted(
        "cmu_playing_with_food",
        10,
        {"primary": "image", "wrist": "finger_vision_1"},
        Arm(gripper=openness(read("action", -1), 0, 1), pose=pose(read("action", 0, 7), "wxyz")),
        bgr=_BGR,
        notes=(
            "the action is a pose, its quaternion's real part first (firephinx/rlds_dataset_builder): it stands for the"
            " pose, since the state is forces only; the hand never turns",
            "grasps and releases tell one pose for the whole episode, so that only presses move",
            _EXCHANGED,
        ),
    ),
    converted(
        "cmu_play_fusion",
        5,
        IMAGE,
        Arm(
            gripper=opening(7),
            action=delta(read("action", 0, 7), "xyzw"),
            gripper_state=openness(read("observation/state", 7, 8), 0, 0.085),
        ),
        metric=False,
        notes=(
            "the rotation is a quaternion; octo and openvla take its tail, the gripper and a flag for rotation",
            _QUATERNION_DOUBTED,
            "the gripper's state is its width, up to 85 mm as thu-ml/RoboticsDiffusionTransformer has it",
        ),
    ),
    converted(
        "cmu_stretch",
        10,
        IMAGE,
        Arm(
            gripper=opening(6),
            pose=pose(read("observation/state", 0, 3), "none"),
            action=delta(read("action", 0, 6), "rpy"),
            gripper_state=openness(read("observation/state", 3, 4), 0, 1),
        ),
        notes=("the state has no rotation",),
    ),
]
