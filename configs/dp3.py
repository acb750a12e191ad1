"""3D Diffusion Policy for keyframes, on the demonstrations of `tiny`. What 3DS-VLA is compared with."""

import dataclasses

from configs.tiny import config as tiny
from dsvla_jax.experiment import Experiment, OptimizerConfig
from dsvla_jax.policies.config import DP3Config


def config() -> Experiment:
    plain = tiny()
    return Experiment(
        baseline=DP3Config(channels=(64, 128, 256)),
        encoding=plain.encoding,
        data=dataclasses.replace(plain.data, shift_world=0.0, state_jitter=0.0),
        optimizer=OptimizerConfig(learning_rate=5e-4, weight_decay=1e-6, average_decay=0.999),
        steps=2500,
        batch_size=32,
    )
