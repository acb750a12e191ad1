"""What decoding must do whichever way visual tokens enter the language model, and whatever the vocabulary."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dsvla_jax.encoding.grammar import AnswerGrammar, NumberSlot
from dsvla_jax.model.config import ModelConfig
from dsvla_jax.model.decode import GREEDY, Decoded, Decoding, make_decoder
from dsvla_jax.model.vla import VLA
from dsvla_jax.types import ModelInputs, Text

SPACE, MINUS, DIGIT, WORD, END = 4, 5, 10, 20, 3


def small_grammar() -> AnswerGrammar:
    """An arm's answer over 40 tokens: numbers of one to three tokens and whole ones, with and without a text between.

    Number 4 follows number 3 without a template, so that either of its first tokens ends number 3.
    """

    def digits(low: int, high: int, space: tuple[int, ...] = (SPACE,)) -> tuple[tuple[int, ...], ...]:
        signed = [((MINUS,) if n < 0 else space, str(abs(n))) for n in range(low, high + 1)]
        return tuple((*sign, *(DIGIT + int(digit) for digit in text)) for sign, text in signed)

    whole = tuple((WORD + n,) for n in range(5))
    pairs = ((WORD,), (WORD + 1, DIGIT), (WORD + 1, DIGIT + 1), (WORD + 1, DIGIT + 2, DIGIT))
    slots = (
        NumberSlot(-12, digits(-12, 14), (6,)),
        NumberSlot(-12, digits(-12, 14), (6,)),
        NumberSlot(-2, whole, (7,)),
        NumberSlot(-3, digits(-3, 11), (MINUS, SPACE)),
        NumberSlot(-3, digits(-3, 11), (6,)),
        NumberSlot(-1, pairs, (7,)),
        NumberSlot(0, digits(0, 12, ()), (6,)),
        NumberSlot(0, ((8,), (9,)), (END,)),
    )
    return AnswerGrammar(((30, 31), (6,), (6,), (7, 32), (), (6,), (7, 33, 34), (6,), (END,)), slots)


def whole_number_grammar() -> AnswerGrammar:
    """An arm's answer of eight tokens, as of a word vocabulary: small numbers, and their end."""
    slots = [NumberSlot(-2, tuple((WORD + n,) for n in range(5)), tuple(range(WORD, WORD + 5)))] * 6
    real = NumberSlot(0, tuple((WORD + 2 + n,) for n in range(5)), (8, 9))
    return AnswerGrammar(((),) * 8 + ((END,),), (*slots, real, NumberSlot(0, ((8,), (9,)), (END,))))


@functools.cache
def decoder(config: ModelConfig, grammar: AnswerGrammar, decoding: Decoding = GREEDY) -> Callable[..., Decoded]:
    """Compiled once."""
    return make_decoder(VLA(config), grammar, decoding)


def check_against_the_full_forward_pass(
    config: ModelConfig, grammar: AnswerGrammar, variables: Any, prompts: ModelInputs
) -> None:
    """Every slot's distribution, worked out without a cache and without a tree: integer by integer, token by token."""
    decoded = decoder(config, grammar)(variables, prompts)
    forward = jax.jit(VLA(config).apply)
    most = max(len(slot.tokens) for slot in grammar.slots)
    longest = prompts.text.tokens.shape[1] + sum(map(len, grammar.templates)) + 4 * len(grammar.slots)
    for b, prompt_length in enumerate(np.asarray(prompts.text.mask.sum(axis=1))):
        text = [*np.asarray(prompts.text.tokens[b, :prompt_length]), *grammar.templates[0]]
        chosen: list[int] = []
        for k, slot in enumerate(grammar.slots):
            rows = np.zeros((most, longest), np.int32)
            for row, tokens in zip(rows, slot.tokens, strict=False):
                row[: len(text) + len(tokens)] = [*text, *tokens]
            one = jax.tree.map(lambda x, b=b: jnp.repeat(x[b : b + 1], most, axis=0), prompts)
            one = dataclasses.replace(one, text=Text(jnp.asarray(rows), jnp.ones(rows.shape, bool)))
            logits: Any = np.asarray(forward(variables, one), np.float64)[:, len(text) - 1 :]
            log_probs = np.array([log_probability(slot, tokens, logits[i]) for i, tokens in enumerate(slot.tokens)])
            np.testing.assert_allclose(np.exp(log_probs).sum(), 1, rtol=1e-4)
            if k % 8 == 6 and not any(chosen[-3:]):
                log_probs[-slot.low] = -np.inf
                log_probs -= np.log(np.exp(log_probs).sum())
            best = int(log_probs.argmax())
            assert decoded.integers[b].ravel()[k] == slot.values[best]
            np.testing.assert_allclose(decoded.log_probs[b].ravel()[k], log_probs[best], atol=2e-4)
            kept = log_probs[np.isfinite(log_probs)]
            np.testing.assert_allclose(decoded.entropies[b].ravel()[k], -(np.exp(kept) * kept).sum(), atol=1e-3)
            chosen.append(slot.values[best])
            text += [*slot.tokens[best], *grammar.templates[k + 1]]


def log_probability(slot: NumberSlot, tokens: tuple[int, ...], logits: np.ndarray) -> float:
    """Of an integer written as ``tokens``: each among all that may stand there, then any that ends the number."""
    total, sentences = 0.0, [(*number, end) for number in slot.tokens for end in slot.ends]
    for place in range(len(tokens) + 1):
        possible = sorted({s[place] for s in sentences if s[:place] == tokens[:place]})
        weights = np.exp(logits[place, possible] - logits[place, possible].max())
        right = np.isin(possible, slot.ends if place == len(tokens) else [tokens[place]])
        total += np.log(weights[right].sum() / weights.sum())
    return total


def check_padding_and_batch_mates(
    config: ModelConfig,
    grammar: AnswerGrammar,
    variables: Any,
    prompts: ModelInputs,
    strangers: ModelInputs,
    lengths: np.ndarray,
) -> None:
    """Neither padding, batch-mates nor the batch's size change an answer.

    strangers: other prompts of the same shapes. lengths: of the prompts, the first without padding.
    """
    decode = decoder(config, grammar)
    together = decode(variables, prompts)
    for b, length in list(enumerate(lengths))[-1:]:
        alone = jax.tree.map(lambda x, b=b: x[b : b + 1], prompts)
        alone = dataclasses.replace(alone, text=jax.tree.map(lambda x, length=length: x[:, :length], alone.text))
        lonely = decode(variables, alone)
        np.testing.assert_array_equal(lonely.integers[0], together.integers[b])
        np.testing.assert_allclose(lonely.log_probs[0], together.log_probs[b], atol=1e-4)
    # What stands in the padding is never read.
    text = prompts.text
    scribbled = dataclasses.replace(prompts, text=Text(jnp.where(text.mask, text.tokens, 3), text.mask))
    np.testing.assert_array_equal(decode(variables, scribbled).log_probs, together.log_probs)
    # Other batch-mates, same shapes: the very same numbers.
    others = decode(variables, jax.tree.map(lambda x, y: x.at[1:].set(y[1:]), prompts, strangers))
    np.testing.assert_array_equal(others.integers[0], together.integers[0])
    np.testing.assert_array_equal(others.log_probs[0], together.log_probs[0])
