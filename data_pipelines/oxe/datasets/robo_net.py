"""RoboNet: self-supervised pushing by robots of several laboratories."""

from data_pipelines.oxe.columns import Delta, Openness, Pose, Read
from data_pipelines.oxe.dataset import ArmColumns
from data_pipelines.oxe.layouts import closing, converted

DATASETS = (
    converted(
        "robo_net",
        1,
        {"primary": "image", "secondary": "image1"},
        ArmColumns(
            gripper=closing(5),
            pose=Pose(Read("observation/state", 0, 4), "yaw"),
            action=Delta(Read("action", 0, 4), "yaw"),
            gripper_state=Openness(Read("observation/state", 4, 5), 0, 1),
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
)
