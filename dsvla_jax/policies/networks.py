"""The network of each policy that answers with poses, by the class of its config."""

from typing import assert_never

from dsvla_jax.encoding.config import EncodingConfig
from dsvla_jax.encoding.text import Tokenizer
from dsvla_jax.model.config import ModelConfig
from dsvla_jax.policies.behaviour_cloning import BehaviourCloning
from dsvla_jax.policies.config import Baseline, BehaviourCloningConfig, DP3Config
from dsvla_jax.policies.dp3 import DP3
from dsvla_jax.policies.pose_network import PoseNetwork


def make_network(baseline: Baseline, encoding: EncodingConfig, model: ModelConfig, tokenizer: Tokenizer) -> PoseNetwork:
    """The network of a baseline. model: of those that have 3DS-VLA's trunk."""
    match baseline:
        case BehaviourCloningConfig():
            return BehaviourCloning(baseline, encoding, model)
        case DP3Config():
            return DP3(baseline, encoding, tokenizer.vocab_size)
        case _:
            assert_never(baseline)
