"""Prompts as token arrays, written inside jit: what `build_prompt` and `encode_text` do on the host, from tables.

A prompt is a beginning that the instruction decides, then numbers with fixed text between. The table holds the tokens
of that text and of every number at every place; that the tokenizer gives just these is checked when it is made.
"""

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from dsvla_jax.encoding.codec import VALUES_PER_ARM
from dsvla_jax.encoding.config import EncodingConfig
from dsvla_jax.encoding.prompts import format_prompt
from dsvla_jax.encoding.text import HIGHEST_NUMBER, LOWEST_NUMBER, Tokenizer
from dsvla_jax.errors import UserError
from dsvla_jax.types import Array


@struct.dataclass
class PromptTable:
    """The tokens of all but the instruction; S numbers in a prompt.

    numbers: int32 (S, 301, M), of each integer from -100 to 200 at each place; number_lengths: int32 (S, 301).
    between: int32 (S, F), of the fixed text behind each number; between_lengths: int32 (S,).
    """

    numbers: np.ndarray | Array
    number_lengths: np.ndarray | Array
    between: np.ndarray | Array
    between_lengths: np.ndarray | Array

    @property
    def longest(self) -> int:
        """Tokens that follow an instruction at most."""
        return int(np.sum(self.between_lengths) + np.sum(np.max(np.asarray(self.number_lengths), axis=1)))


def make_prompt_table(tokenizer: Tokenizer, config: EncodingConfig, arms: int) -> PromptTable:
    """The table of prompts for so many arms. Raises UserError where a number's tokens depend on its neighbours."""
    slots = arms * (VALUES_PER_ARM + (3 if config.use_keypoints else 0))
    ones = _tokens(tokenizer, config, "", np.ones(slots, int))
    starts = []
    for slot in range(slots):
        other = _tokens(tokenizer, config, "", np.where(np.arange(slots) == slot, 2, 1))
        differ = np.flatnonzero(np.array(ones) != np.array(other)) if len(ones) == len(other) else np.array([])
        if len(differ) != 1:
            raise UserError(f"tokenizer: expected the digit of number {slot} of a prompt to be one token of its own")
        starts.append(int(differ[0]))
    values, numbers = range(LOWEST_NUMBER, HIGHEST_NUMBER + 1), []
    for slot, start in enumerate(starts):
        behind = len(ones) - start - 1
        for value in values:
            tokens = _tokens(tokenizer, config, "", np.where(np.arange(slots) == slot, value, 1))
            if tokens[:start] != ones[:start] or tokens[len(tokens) - behind :] != ones[start + 1 :]:
                raise UserError(f"tokenizer: the tokens of {value} run into the text around it; decode on the host")
            numbers.append(tokens[start : len(tokens) - behind])
    between = [ones[start + 1 : end] for start, end in zip(starts, [*starts[1:], len(ones)], strict=True)]
    number_rows, number_lengths = _padded(numbers)
    between_rows, between_lengths = _padded(between)
    shape = (slots, len(values))
    return PromptTable(number_rows.reshape(*shape, -1), number_lengths.reshape(shape), between_rows, between_lengths)


def instruction_tokens(
    tokenizer: Tokenizer, config: EncodingConfig, arms: int, instructions: list[str]
) -> tuple[np.ndarray, np.ndarray]:
    """What stands before the first number of each prompt, on the host: tokens int32 (B, P) and lengths int32 (B,)."""
    ones = np.ones(arms * (VALUES_PER_ARM + (3 if config.use_keypoints else 0)), int)
    empty, twos = _tokens(tokenizer, config, "", ones), ones.copy()
    twos[0] = 2
    start = int(np.flatnonzero(np.array(empty) != np.array(_tokens(tokenizer, config, "", twos)))[0])
    tail, rows = empty[start:], []
    for instruction in instructions:
        tokens = _tokens(tokenizer, config, instruction, ones)
        if tokens[len(tokens) - len(tail) :] != tail:
            raise UserError(f"tokenizer: the numbers' tokens depend on the instruction {instruction!r}")
        rows.append([tokenizer.bos_id, *tokens[: len(tokens) - len(tail)]])
    return _padded(rows)


def write_prompts(
    table: PromptTable, beginnings: Array, lengths: Array, integers: Array, size: int, pad_id: int
) -> tuple[Array, Array]:
    """The prompts of a batch, inside jit: tokens int32 (B, T) and mask bool (B, T), T = ``size``.

    beginnings: int32 (B, P), lengths: int32 (B,), see `instruction_tokens`. integers: int32 (B, S), the arms' states,
    then their keypoints.
    """

    def one(beginning: Array, length: Array, values: Array) -> tuple[Array, Array]:
        rows = jnp.arange(len(table.between))
        at = jnp.clip(values - LOWEST_NUMBER, 0, HIGHEST_NUMBER - LOWEST_NUMBER)
        written = [jnp.asarray(table.numbers)[rows, at], jnp.asarray(table.between)]
        counts = [jnp.asarray(table.number_lengths)[rows, at], jnp.asarray(table.between_lengths)]
        ends = length + jnp.cumsum(jnp.stack(counts, axis=1).reshape(-1))
        begins = (ends - jnp.stack(counts, axis=1).reshape(-1)).reshape(-1, 2)
        text = jnp.full(size, pad_id, jnp.int32)
        places = jnp.arange(beginning.shape[0])
        text = text.at[jnp.where(places < length, places, size)].set(beginning, mode="drop")
        for column, (tokens, count) in enumerate(zip(written, counts, strict=True)):
            inside = jnp.arange(tokens.shape[1])
            places = jnp.where(inside < count[:, None], begins[:, column, None] + inside, size)
            text = text.at[places].set(tokens, mode="drop")
        return text, jnp.arange(size) < ends[-1]

    return jax.vmap(one)(beginnings, lengths, integers)


def _tokens(tokenizer: Tokenizer, config: EncodingConfig, instruction: str, values: np.ndarray) -> list[int]:
    arms = len(values) // (VALUES_PER_ARM + (3 if config.use_keypoints else 0))
    states = values[: arms * VALUES_PER_ARM].reshape(arms, VALUES_PER_ARM)
    keypoints = values[arms * VALUES_PER_ARM :].reshape(arms, 3) if config.use_keypoints else None
    return list(tokenizer.encode(format_prompt(instruction, states, keypoints, config.style)))


def _padded(rows: list[list[int]]) -> tuple[np.ndarray, np.ndarray]:
    lengths = np.array([len(row) for row in rows], np.int32)
    padded = np.zeros((len(rows), max(1, int(lengths.max()))), np.int32)
    for i, row in enumerate(rows):
        padded[i, : len(row)] = row
    return padded, lengths
