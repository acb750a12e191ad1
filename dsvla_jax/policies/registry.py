"""Learners and policies from a config: the one place that knows which policies there are."""

from typing import Any

from dsvla_jax.encoding.text import Tokenizer
from dsvla_jax.model.decode import GREEDY, Decoding
from dsvla_jax.model.variables import Variables
from dsvla_jax.policies.config import PolicyConfig
from dsvla_jax.policies.interface import Learner, Policy
from dsvla_jax.policies.networks import make_network, vector_space
from dsvla_jax.policies.pose_policy import PoseLearner, PosePolicy
from dsvla_jax.policies.three_ds_vla import TextPolicy, text_learner

ConfiguredLearner = Learner[Any, Any]
"""A learner whose kind of examples the config decides, which no annotation can know."""


def make_learner(
    config: PolicyConfig, tokenizer: Tokenizer, soft_target_sigma: float = 0.0, cameras: int = 1
) -> ConfiguredLearner:
    """How a policy learns, from examples of its own kind.

    soft_target_sigma: see `text_learner`. cameras: C, in examples.
    """
    if config.baseline is None:
        return text_learner(config.encoding, config.model, tokenizer, soft_target_sigma)
    return PoseLearner(make_network(config, tokenizer), config.encoding, vector_space(config), cameras)


def make_policy(
    config: PolicyConfig, variables: Variables, tokenizer: Tokenizer, decoding: Decoding = GREEDY
) -> Policy:
    """A policy ready to act. decoding: of 3DS-VLA's answers."""
    if config.baseline is None:
        return TextPolicy(config, variables, tokenizer, decoding)
    return PosePolicy(config, variables, tokenizer)
