"""What decoding must do whichever way visual tokens enter the language model."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dsvla_jax.model.config import ModelConfig
from dsvla_jax.model.decode import Grammar, make_decoder
from dsvla_jax.model.vla import VLA
from dsvla_jax.types import ModelInputs


def check_padding_and_batch_mates(
    config: ModelConfig,
    grammar: Grammar,
    variables: Any,
    prompts: ModelInputs,
    strangers: ModelInputs,
    lengths: np.ndarray,
) -> None:
    """Neither padding nor batch-mates change an answer.

    strangers: other prompts of the same shapes. lengths: of the prompts, the first without padding.
    """
    decode = make_decoder(VLA(config), grammar)
    tokens, log_probs = decode(variables, prompts)
    for b, length in list(enumerate(lengths))[1:]:
        alone = jax.tree.map(lambda x, b=b: x[b : b + 1], prompts)
        alone = dataclasses.replace(
            alone, text_tokens=alone.text_tokens[:, :length], text_mask=alone.text_mask[:, :length]
        )
        lonely_tokens, lonely_log_probs = decode(variables, alone)
        np.testing.assert_array_equal(lonely_tokens[0], tokens[b])
        np.testing.assert_allclose(lonely_log_probs[0], log_probs[b], atol=1e-4)
    # What stands in the padding is never read.
    scribbled = dataclasses.replace(prompts, text_tokens=jnp.where(prompts.text_mask, prompts.text_tokens, 3))
    np.testing.assert_array_equal(decode(variables, scribbled)[1], log_probs)
    # Other batch-mates, same shapes: the very same numbers.
    others = jax.tree.map(lambda x, y: x.at[1:].set(y[1:]), prompts, strangers)
    np.testing.assert_array_equal(decode(variables, others)[0][0], tokens[0])
    np.testing.assert_array_equal(decode(variables, others)[1][0], log_probs[0])
