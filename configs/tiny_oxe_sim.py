"""Finetuning in simulation on what `tiny_oxe` learned: adapters and projection on its frozen base, with 3D input."""

from dataclasses import replace

from configs import tiny
from dsvla_jax.experiment import Experiment
from dsvla_jax.model.config import LoraConfig


def config() -> Experiment:
    base = tiny.config()
    return replace(
        base, regime="lora", base="runs/tiny_oxe", steps=200, model=replace(base.model, lora=LoraConfig(rank=8))
    )
