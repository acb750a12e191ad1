"""FurnitureBench: furniture assembled by a Franka."""

from data_pipelines.oxe.columns import Delta, Openness, Pose, Read
from data_pipelines.oxe.dataset import ArmColumns
from data_pipelines.oxe.layouts import FRANKA_WIDTH, IMAGE_AND_WRIST, SUFFIX, closing, converted

DATASETS = (
    converted(
        f"furniture_bench_dataset{SUFFIX}",
        10,
        IMAGE_AND_WRIST,
        ArmColumns(
            gripper=closing(8),
            pose=Pose(Read("observation/state", 0, 7), "xyzw"),
            action=Delta(Read("action", 0, 7), "xyzw"),
            gripper_state=Openness(Read("observation/state", 34, 35), 0, FRANKA_WIDTH),
        ),
        notes=("the action's rotation is a quaternion",),
    ),
)
