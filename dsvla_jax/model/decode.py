"""Decoding of actions that cannot be malformed.

The answer's form is known beforehand: a template of forced tokens with free slots, each slot restricted to the tokens
that its grammar allows. The prompt is read once into a key/value cache; then each free slot costs one sequential pass,
which reads the chosen token together with the template tokens that follow it. Greedy, hence deterministic.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, Protocol

import jax
import jax.core
import jax.numpy as jnp
import numpy as np

from dsvla_jax.model.llama import KVCache
from dsvla_jax.model.vla import VLA
from dsvla_jax.types import ModelInputs

Array = jax.Array


class Grammar(Protocol):
    """The form of an answer, as ``dsvla_jax.encoding.text.build_answer_grammar`` makes it.

    forced: int32 (L,), the template's token, -1 where the slot is free. allowed: bool (L, V), read at free slots.
    forbidden, optional: int32 (R, L), combinations that must not come out, such as a quaternion of four zeros. A row
        holds tokens at free slots and -1 elsewhere; an answer never has all the tokens of a row.
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
    forced, allowed, forbidden = _concrete(grammar)
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
    fed = int(free[-1]) - lead  # the answer's tokens that are ever read
    prompt = _append(inputs, forced[:lead])
    prefilled: Any = model.apply(variables, prompt, fed, method="prefill")
    logits, cache = prefilled
    slots = jnp.arange(cache.keys.shape[3])
    start = cache.keys.shape[3] - fed
    visual_tokens = start - prompt.text_tokens.shape[1]
    prompt_lengths = visual_tokens + prompt.text_mask.sum(axis=1).astype(jnp.int32)
    in_prompt = slots[None, :] < prompt_lengths[:, None]

    def choose(logits: Array, answer: Array, place: Array | int) -> tuple[Array, Array]:
        permitted = jnp.asarray(allowed)[place] & ~_completes(jnp.asarray(forbidden), answer, place, allowed.shape[1])
        logits = jnp.where(permitted, logits, -jnp.inf)
        token = jnp.argmax(logits, axis=-1).astype(jnp.int32)
        log_prob = jnp.take_along_axis(jax.nn.log_softmax(logits), token[:, None], axis=-1)[:, 0]
        return answer.at[:, place].set(token), log_prob

    def fill_place(carry: tuple[Array, KVCache, Array], xs: tuple[Array, Array]) -> tuple[Any, Array]:
        logits, cache, answer = carry
        places, offset = xs
        answer, log_prob = choose(logits, answer, places[0])
        # Answer tokens share their slots across the batch, behind the longest prompt; positions are each example's.
        steps = offset + jnp.arange(places.shape[0])
        in_answer = (slots >= start) & (slots[None, :] <= start + steps[:, None])
        mask = in_prompt[:, None, :] | in_answer[None]
        positions = prompt_lengths[:, None] + steps[None]
        extended: Any = model.apply(
            variables, answer[:, places], positions, mask, cache, start + offset, method="extend"
        )
        return (*extended, answer), log_prob

    # Free places followed by equally many template tokens run as one loop, so that compile time does not grow with
    # them. Each iteration reads the place's token together with the template tokens that follow it.
    free_log_probs = []
    for first, count, width in _runs(free):
        places = first + np.arange(count * width).reshape(count, width)
        xs = (jnp.asarray(places), jnp.asarray(places[:, 0] - lead))
        (logits, cache, answer), run_log_probs = jax.lax.scan(fill_place, (logits, cache, answer), xs)
        free_log_probs.append(run_log_probs.T)
    answer, log_prob = choose(logits, answer, int(free[-1]))
    free_log_probs.append(log_prob[:, None])
    return answer, log_probs.at[:, free].set(jnp.concatenate(free_log_probs, axis=1))


def make_decoder(model: VLA, grammar: Grammar) -> Callable[[Any, ModelInputs], tuple[Array, Array]]:
    """A jitted ``(variables, inputs) -> tokens, log_probs`` for one grammar."""
    return jax.jit(lambda variables, inputs: decode_actions(model, variables, inputs, grammar))


def _concrete(grammar: Grammar) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    if any(isinstance(leaf, jax.core.Tracer) for leaf in (grammar.forced, grammar.allowed)):
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
    forbidden = np.asarray(getattr(grammar, "forbidden", np.zeros((0, len(forced)))), np.int32)
    if forbidden.ndim != 2 or forbidden.shape[1] != len(forced):
        raise ValueError(f"grammar: expected forbidden (R, {len(forced)}), got {forbidden.shape}")
    return forced, allowed, forbidden


def _completes(forbidden: Array, answer: Array, place: Array | int, vocab_size: int) -> Array:
    """bool (B, V): the tokens which at ``place`` would complete a forbidden combination. Later places are still -1."""
    tokens = forbidden[:, place]
    matches = (forbidden[None] < 0) | (forbidden[None] == answer[:, None])  # (B, R, L)
    complete = matches.at[:, :, place].set(True).all(axis=-1) & (tokens >= 0)
    return (complete[:, :, None] & (tokens[:, None] == jnp.arange(vocab_size))).any(axis=1)


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
