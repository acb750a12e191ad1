"""Decoding of actions that cannot be malformed.

The answer's form is known beforehand: a template of forced tokens with free slots, each slot restricted to the tokens
that its grammar allows. The prompt is read once into a key/value cache; then each free slot costs one sequential pass,
which reads the chosen token together with the template tokens that follow it. Greedy, hence deterministic.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from dsvla_jax.model.llama import KVCache
from dsvla_jax.model.vla import VLA
from dsvla_jax.types import ModelInputs

Array = jax.Array


class Grammar(Protocol):
    """The form of an answer, as ``dsvla_jax.encoding.text.build_answer_grammar`` makes it.

    forced: int32 (L,), the template's token, -1 where the slot is free. allowed: bool (L, V), read at free slots.
    """

    @property
    def forced(self) -> Any: ...
    @property
    def allowed(self) -> Any: ...


def decode_actions(model: VLA, variables: Any, inputs: ModelInputs, grammar: Grammar) -> tuple[Array, Array]:
    """Greedy answers of a batch: tokens int32 (B, L) and their log-probabilities float32 (B, L).

    inputs: batched, the text being prompts without answers, padded at the end to one length; padding and the other
        examples of the batch have no influence on an answer.
    grammar: concrete arrays, since its template decides the shape of the computation; close over it under ``jax.jit``
        (``make_decoder`` does).
    A log-probability is that among the allowed tokens of the slot; it is 0 for forced tokens.
    """
    forced, allowed = _concrete(grammar)
    length = forced.shape[0]
    batch = inputs.text_tokens.shape[0]
    answer = jnp.broadcast_to(jnp.asarray(forced), (batch, length))
    log_probs = jnp.zeros((batch, length), jnp.float32)
    free = np.flatnonzero(forced < 0)
    if free.size == 0:
        return answer, log_probs
    if allowed.shape[1] != model.config.language.vocab_size:
        raise ValueError(
            f"grammar: made for a vocabulary of {allowed.shape[1]} tokens, the model has "
            f"{model.config.language.vocab_size}; build both from one tokenizer"
        )

    lead = int(free[0])
    prompt = _append(inputs, forced[:lead])
    logits, cache = model.apply(variables, prompt, int(free[-1]) - lead, method="prefill")
    start = cache.keys.shape[3] - (int(free[-1]) - lead)
    visual_tokens = start - prompt.text_tokens.shape[1]
    prompt_lengths = visual_tokens + prompt.text_mask.sum(axis=1).astype(jnp.int32)
    slots = jnp.arange(cache.keys.shape[3])
    in_prompt = slots[None, :] < prompt_lengths[:, None]

    def read(cache: KVCache, tokens: Array, offset: Array) -> tuple[Array, KVCache]:
        # Answer tokens share their slots across the batch, behind the longest prompt; positions are each example's.
        steps = offset + jnp.arange(tokens.shape[1])
        in_answer = (slots >= start) & (slots[None, :] <= start + steps[:, None])
        mask = in_prompt[:, None, :] | in_answer[None]
        positions = prompt_lengths[:, None] + steps[None]
        return model.apply(variables, tokens, positions, mask, cache, start + offset, method="extend")

    def fill_slot(carry: tuple[Array, KVCache], slot: tuple[Array, Array, Array]):
        logits, cache = carry
        slot_allowed, following, offset = slot
        token, log_prob = _choose(logits, slot_allowed)
        chunk = jnp.concatenate([token[:, None], jnp.broadcast_to(following, (batch, *following.shape))], axis=1)
        logits, cache = read(cache, chunk, offset)
        return (logits, cache), (token, log_prob)

    # Slots followed by equally many template tokens run as one loop, so that compile time does not grow with them.
    chosen, chosen_log_probs = [], []
    for first, count, width in _runs(free):
        rows = first + width * np.arange(count)
        following = np.stack([forced[row + 1 : row + width] for row in rows])
        xs = (jnp.asarray(allowed[rows]), jnp.asarray(following), jnp.asarray(rows - lead))
        (logits, cache), (tokens, token_log_probs) = jax.lax.scan(fill_slot, (logits, cache), xs)
        chosen.append(tokens.T)
        chosen_log_probs.append(token_log_probs.T)
    token, log_prob = _choose(logits, jnp.asarray(allowed[free[-1]]))
    tokens = jnp.concatenate([*chosen, token[:, None]], axis=1)
    token_log_probs = jnp.concatenate([*chosen_log_probs, log_prob[:, None]], axis=1)
    return answer.at[:, free].set(tokens), log_probs.at[:, free].set(token_log_probs)


def make_decoder(model: VLA, grammar: Grammar) -> Callable[[Any, ModelInputs], tuple[Array, Array]]:
    """A jitted ``(variables, inputs) -> tokens, log_probs`` for one grammar."""
    return jax.jit(lambda variables, inputs: decode_actions(model, variables, inputs, grammar))


def _concrete(grammar: Grammar) -> tuple[np.ndarray, np.ndarray]:
    if isinstance(grammar.forced, jax.core.Tracer) or isinstance(grammar.allowed, jax.core.Tracer):
        raise TypeError(
            "grammar: got traced arrays; its template decides the shape of the computation, so close over the grammar "
            "instead of passing it through jax.jit (see make_decoder)"
        )
    forced, allowed = np.asarray(grammar.forced, np.int32), np.asarray(grammar.allowed, bool)
    if forced.ndim != 1 or allowed.ndim != 2 or allowed.shape[0] != forced.shape[0]:
        raise ValueError(f"grammar: expected forced (L,) and allowed (L, V), got {forced.shape} and {allowed.shape}")
    empty = np.flatnonzero((forced < 0) & ~allowed.any(axis=1))
    if empty.size:
        raise ValueError(f"grammar: free slots {empty.tolist()} allow no token at all")
    return forced, allowed


def _append(inputs: ModelInputs, tokens: np.ndarray) -> ModelInputs:
    """The prompts with ``tokens`` after each one's last valid token, still padded at the end."""
    count = tokens.shape[0]
    if count == 0:
        return inputs
    text = jnp.pad(inputs.text_tokens, ((0, 0), (0, count)))
    behind = jnp.arange(text.shape[1])[None] - inputs.text_mask.sum(axis=1, keepdims=True)
    text = jnp.where((behind >= 0) & (behind < count), jnp.asarray(tokens)[jnp.clip(behind, 0, count - 1)], text)
    return dataclasses.replace(inputs, text_tokens=text, text_mask=behind < count)


def _runs(free: np.ndarray) -> list[tuple[int, int, int]]:
    """(first slot, slots, distance between slots) of each run of equally spaced free slots; not the last slot."""
    runs: list[tuple[int, int, int]] = []
    for slot, width in zip(free[:-1].tolist(), np.diff(free).tolist(), strict=True):
        if runs and runs[-1][2] == width:
            first, count, _ = runs.pop()
            runs.append((first, count + 1, width))
        else:
            runs.append((slot, 1, width))
    return runs


def _choose(logits: Array, allowed: Array) -> tuple[Array, Array]:
    """The likeliest allowed token int32 (B,) of logits (B, V), and its log-probability among the allowed."""
    logits = jnp.where(allowed, logits, -jnp.inf)
    token = jnp.argmax(logits, axis=-1)
    log_prob = jnp.take_along_axis(jax.nn.log_softmax(logits), token[:, None], axis=-1)[:, 0]
    return token.astype(jnp.int32), log_prob
