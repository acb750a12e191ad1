"""Datasets of DLR: SARA and EDAN."""

from data_pipelines.oxe.columns import Openness, Read
from data_pipelines.oxe.layouts import SUFFIX, closing, reached

_ZXY = "angles are about fixed z, x, y: octo and openvla take them for roll, pitch, yaw"


_WATCHED = (
    "1 is closed, as thu-ml/RoboticsDiffusionTransformer found by watching episodes: octo and openvla keep it the wrong"
    " way round"
)


DATASETS = (
    *(
        reached(f"dlr_sara_{task}{SUFFIX}", 10, "zxy", gripper=closing(7), notes=(_ZXY, _WATCHED))
        for task in ("pour", "grid_clamp")
    ),
    reached(
        f"dlr_edan_shared_control{SUFFIX}",
        5,
        "zxy",
        gripper=closing(7),
        gripper_state=Openness(Read("observation/state", 6, 7), 1, 0),
        notes=(_ZXY,),
    ),
)
