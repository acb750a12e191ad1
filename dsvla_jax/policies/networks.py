"""The network of each policy that answers with poses, by the class of its config, and what its vectors count in."""

from typing import assert_never

from dsvla_jax.encoding.text import Tokenizer
from dsvla_jax.policies.behaviour_cloning import BehaviourCloning
from dsvla_jax.policies.config import BehaviourCloningConfig, DP3Config, PolicyConfig
from dsvla_jax.policies.dp3 import DP3
from dsvla_jax.policies.pose_network import PoseNetwork
from dsvla_jax.policies.pose_vectors import VectorSpace


def make_network(config: PolicyConfig, tokenizer: Tokenizer) -> PoseNetwork:
    """The network of a policy whose config has a baseline."""
    match config.baseline:
        case BehaviourCloningConfig():
            return BehaviourCloning(config.baseline, config.encoding, config.model)
        case DP3Config():
            return DP3(config.baseline, config.encoding, vector_space(config), tokenizer.vocab_size)
        case None:
            raise ValueError("make_network: expected a config with a baseline")
        case _:
            assert_never(config.baseline)


def vector_space(config: PolicyConfig) -> VectorSpace:
    """What the vectors of a policy's network count in."""
    return VectorSpace(config.encoding.codec, config.vector_scale)
