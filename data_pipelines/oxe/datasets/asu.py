"""ASU's table-top manipulation."""

from data_pipelines.oxe.columns import Openness, Read
from data_pipelines.oxe.layouts import SUFFIX, reached

DATASETS = (
    reached(
        f"asu_table_top{SUFFIX}",
        12.5,
        "rpy",
        gripper_state=Openness(Read("observation/state", 6, 7), 0, 1),
        state="ground_truth_states/EE",
        notes=("the page calls the action joint velocities",),
    ),
)
