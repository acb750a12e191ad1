"""Row 2 of the paper's Table 3: the keypoint constraint joins the prompt; no 3D tokens."""

from dataclasses import replace

from configs import tiny
from dsvla_jax.experiment import Experiment


def config() -> Experiment:
    base = tiny.config()
    return replace(base, encoding=replace(base.encoding, use_points=False))
