"""Google's robots: RT-1 (fractal), QT-Opt (kuka), BC-Z and Language-Table."""

import dataclasses

import numpy as np
from scipy.spatial.transform import Rotation

from data_pipelines.oxe.columns import Constant, Delta, Join, Openness, Pose, Read, RelativeClosing
from data_pipelines.oxe.dataset import ArmColumns, OxeDataset
from data_pipelines.oxe.layouts import BUCKET, CLOSING_ACTION, LANGUAGE, moved
from data_pipelines.rlds.features import RldsEpisode


@dataclasses.dataclass(frozen=True)
class _Succeeded:
    """Keeps the episodes that are marked as successes, and those without a mark."""

    def __call__(self, episode: RldsEpisode) -> bool:
        return "success" not in episode or bool(episode.column("success"))


@dataclasses.dataclass(frozen=True)
class _BcZAction:
    """The residual of the first waypoint as a displacement: it is added to the axis-angle, not multiplied."""

    def __call__(self, episode: RldsEpisode) -> np.ndarray:
        present = Read("observation/present/axis_angle")(episode)
        moved = Read("action/future/xyz_residual", 0, 3)(episode)
        turned = present + Read("action/future/axis_angle_residual", 0, 3)(episode)
        rotation = Rotation.from_rotvec(turned) * Rotation.from_rotvec(present).inv()
        return np.concatenate([moved, rotation.as_rotvec()], axis=1)


DATASETS = (
    OxeDataset(
        "fractal20220817_data",
        3,
        f"{BUCKET}/fractal20220817_data/0.1.0",
        {"primary": "image"},
        (
            ArmColumns(
                gripper=RelativeClosing(CLOSING_ACTION),
                pose=Pose(Read("observation/base_pose_tool_reached"), "xyzw"),
                action=moved(),
                gripper_state=Openness(Read("observation/gripper_closed"), 1, 0),
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
            ArmColumns(
                gripper=RelativeClosing(CLOSING_ACTION),
                pose=Pose(Read("observation/clip_function_input/base_pose_tool_reached"), "xyzw"),
                action=moved(),
                gripper_state=Openness(Read("observation/gripper_closed"), 1, 0),
            ),
        ),
        LANGUAGE,
        keep=_Succeeded(),
        notes=(
            "self-supervised grasping: only episodes marked as successes are used",
            "states are zlib-compressed tensors: features.json says so, and the reader unpacks them",
            "one instruction for all episodes",
        ),
    ),
    OxeDataset(
        "language_table",
        10,
        f"{BUCKET}/language_table/0.0.1",
        {"primary": "rgb"},
        (
            ArmColumns(
                gripper=Constant(1.0),
                pose=Pose(Read("observation/effector_translation"), "none"),
                action=Delta(Read("action"), "none"),
            ),
        ),
        "observation/instruction",
        code_points=True,
        notes=("planar, no gripper: height 0, always open", "the instruction is a row of code points, ended by a zero"),
    ),
    OxeDataset(
        "bc_z",
        10,
        f"{BUCKET}/bc_z/0.1.0",
        {"primary": "image"},
        (
            ArmColumns(
                gripper=Openness(Read("action/future/target_close", 0, 1), 1, 0),
                pose=Pose(Join(Read("observation/present/xyz"), Read("observation/present/axis_angle")), "rotvec"),
                action=_BcZAction(),
                gripper_state=Openness(Read("observation/present/sensed_close"), 1, 0.2),
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
)
