"""The paper's finetuning regime at the size of `tiny`: adapters and projection learn on a frozen base."""

from dataclasses import replace

from configs import tiny
from dsvla_jax.model.config import LoraConfig
from dsvla_jax.training.experiment import Experiment


def config() -> Experiment:
    base = tiny.config()
    return replace(base, regime="lora", base="runs/tiny", steps=200, model=replace(base.model, lora=LoraConfig(rank=8)))
