"""KAIST's nonprehensile manipulation."""

from data_pipelines.oxe.columns import Constant, Delta, Pose, Read
from data_pipelines.oxe.dataset import ArmColumns
from data_pipelines.oxe.layouts import IMAGE, SUFFIX, converted

DATASETS = (
    converted(
        f"kaist_nonprehensile{SUFFIX}",
        10,
        IMAGE,
        ArmColumns(
            gripper=Constant(0.0),
            pose=Pose(Read("observation/state", 14, 21), "xyzw"),
            action=Delta(Read("action", 0, 6), "rotvec"),
        ),
        notes=("rotations are axis-angle; 14 columns of gains follow", "it pushes with a closed gripper"),
    ),
)
