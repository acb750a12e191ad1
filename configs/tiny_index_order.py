"""Row 3 of the paper's Table 3: 3D tokens carry the 2D positional embeddings in index order, not the aligned ones."""

from dataclasses import replace

from configs import tiny
from dsvla_jax.experiment import Experiment


def config() -> Experiment:
    base = tiny.config()
    return replace(base, encoding=replace(base.encoding, alignment="index_order"))
