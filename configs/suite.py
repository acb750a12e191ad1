"""One policy for all 26 tasks, single-arm and dual-arm. Trains for about 45 minutes on two processor cores."""

import dataclasses

from configs.tiny import config as tiny
from dsvla_jax.experiment import Experiment, OptimizerConfig

PATCH = 16


def config() -> Experiment:
    plain = tiny()
    # At this width the paper's wavelengths cannot resolve a token's position; these can. Twice as many 3D tokens.
    points = dataclasses.replace(plain.encoding.points, alpha=10.0, beta=12.0, group_sizes=(128, 64, 32))
    encoding = dataclasses.replace(plain.encoding, patch_size=PATCH, points=points)
    vision = dataclasses.replace(plain.model.vision, patch_size=PATCH)
    return dataclasses.replace(
        plain,
        encoding=encoding,
        model=dataclasses.replace(plain.model, vision=vision),
        # Shifting the world without telling the vision tower the camera's pose hides absolute positions from it.
        data=dataclasses.replace(plain.data, tasks=("all",), folder="data/suite", shift_world=0.0),
        optimizer=OptimizerConfig(method="muon", learning_rate=2e-3, average_decay=0.998),
        steps=4800,
        checkpoint_every=600,
    )
