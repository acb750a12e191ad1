"""ManiSkill2: simulated manipulation with calibrated depth."""

from data_pipelines.oxe.columns import Delta, InBase, Openness, Pose, Read
from data_pipelines.oxe.dataset import ArmColumns, Depth
from data_pipelines.oxe.layouts import FRANKA_WIDTH, IMAGE_AND_WRIST, SUFFIX, converted

_MANISKILL_POSE = Pose(Read("observation/tcp_pose"), "wxyz")


DATASETS = (
    converted(
        f"maniskill_dataset{SUFFIX}",
        20,
        IMAGE_AND_WRIST,
        ArmColumns(
            gripper=Openness(Read("action", 6, 7), -1, 1),
            pose=_MANISKILL_POSE,
            action=InBase(Delta(Read("action", 0, 6), "rotvec", 0.1, 0.1), _MANISKILL_POSE),
            gripper_state=Openness(Read("observation/state", 7, 8), 0, FRANKA_WIDTH / 2),
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
)
