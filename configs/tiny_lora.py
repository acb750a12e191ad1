"""The paper's finetuning regime at the size of `tiny`: adapters and projection learn on a frozen base."""

from dataclasses import replace

from configs import tiny
from dsvla_jax.experiment import Experiment
from dsvla_jax.model.config import LoraConfig


def config() -> Experiment:
    base = tiny.config()
    return replace(base, regime="lora", base="runs/tiny", steps=200, model=replace(base.model, lora=LoraConfig(rank=8)))
