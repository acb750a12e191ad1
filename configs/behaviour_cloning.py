"""Behaviour cloning on `tiny`'s trunk: the keyframe as numbers instead of text. What 3DS-VLA is compared with."""

import dataclasses

from configs.tiny import config as tiny
from dsvla_jax.experiment import Experiment
from dsvla_jax.policies.config import BehaviourCloningConfig


def config() -> Experiment:
    plain = tiny()
    # Answers are given from where the arm says that it is.
    data = dataclasses.replace(plain.data, state_jitter=0.0)
    return dataclasses.replace(plain, baseline=BehaviourCloningConfig(), data=data, soft_target_sigma=0.0)
