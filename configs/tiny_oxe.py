"""Pretraining on Open X-Embodiment at the size of `tiny`, here on fixtures: pictures, text and poses, no 3D input.

The paper's extra experiment learns from these data, which have no 3D, and then in simulation: `tiny_oxe_sim`.
docs/data_oxe.md has the commands.
"""

from dataclasses import replace

from configs import tiny
from dsvla_jax.data_config import OxeConfig
from dsvla_jax.experiment import Experiment

MIXTURE = (
    "bridge_dataset",
    "fractal20220817_data=0.5",
    "nyu_rot_dataset_converted_externally_to_rlds",
    "utokyo_xarm_bimanual_converted_externally_to_rlds",
    "viola",
)


def config() -> Experiment:
    base = tiny.config()
    return replace(
        base,
        encoding=replace(base.encoding, use_points=False, use_keypoints=False),
        oxe=OxeConfig(
            folder="data/oxe_fixtures", mixture=MIXTURE, target="absolute", image_size=base.encoding.image_size
        ),
        steps=200,
    )
