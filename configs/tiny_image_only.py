"""Row 1 of the paper's Table 3: image, robot state and instruction only."""

from dataclasses import replace

from configs import tiny
from dsvla_jax.experiment import Experiment


def config() -> Experiment:
    base = tiny.config()
    return replace(base, encoding=replace(base.encoding, use_keypoints=False, use_points=False))
