"""Prompts written inside jit are those that the host writes, token by token."""

import jax
import numpy as np
import pytest

from dsvla_jax.encoding.config import EncodingConfig
from dsvla_jax.encoding.encode import build_prompt, encode_text
from dsvla_jax.encoding.prompt_table import instruction_tokens, make_prompt_table, write_prompts
from dsvla_jax.encoding.text import WordTokenizer, vocabulary
from dsvla_jax.types import RobotState

INSTRUCTIONS = ["turn on the light", "stack 3 red blocks", "close the fridge"]


@pytest.mark.parametrize("style", ["compact", "paper"])
@pytest.mark.parametrize("arms", [1, 2])
@pytest.mark.parametrize("use_keypoints", [True, False])
def test_prompts_are_those_of_the_host(style, arms, use_keypoints):
    tokenizer = WordTokenizer(vocabulary(INSTRUCTIONS))
    config = EncodingConfig(style=style, use_keypoints=use_keypoints, max_text_length=320)
    rng, batch = np.random.default_rng(0), len(INSTRUCTIONS)
    pose = rng.uniform(-1, 1, (batch, arms, 7)).astype(np.float32)
    gripper, keypoints = rng.random((batch, arms)), rng.uniform(-1, 1, (batch, arms, 3)).astype(np.float32)
    table = make_prompt_table(tokenizer, config, arms)
    beginnings, lengths = instruction_tokens(tokenizer, config, arms, INSTRUCTIONS)
    integers = config.codec.encode(pose, gripper).reshape(batch, -1)
    if use_keypoints:
        near = config.codec.encode_position(keypoints).reshape(batch, -1)
        integers = np.concatenate([np.asarray(integers), np.asarray(near)], axis=1)
    size = beginnings.shape[1] + table.longest
    write = jax.jit(lambda said, count, numbers: write_prompts(table, said, count, numbers, size, tokenizer.pad_id))
    tokens, mask = write(beginnings, lengths, integers)
    for i, instruction in enumerate(INSTRUCTIONS):
        prompt = build_prompt(config, instruction, RobotState(pose[i], gripper[i]), keypoints[i])
        expected, _ = encode_text(tokenizer, prompt, None, config.max_text_length)
        length = int(expected.mask.sum())
        assert int(mask[i].sum()) == length
        np.testing.assert_array_equal(tokens[i, :length], expected.tokens[:length])
        assert (np.asarray(tokens)[i, length:] == tokenizer.pad_id).all()
