"""Decoding of actions that cannot be malformed.

The answer's form is known beforehand: fixed templates with a number in between. The prompt is read once into a
key/value cache. Then every number costs one pass, whatever its tokens: the pass reads the number before it, the
template between the two, and the tree of the number's own integers (``integer_trie``), and gives the probability of
each integer that the slot admits. docs/decoding.md has the picture.
"""

import dataclasses
import itertools
from collections.abc import Callable
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from dsvla_jax.encoding.codec import QUATERNION_VALUES, VALUES_PER_ARM
from dsvla_jax.encoding.grammar import AnswerGrammar
from dsvla_jax.model.integer_trie import (
    Branches,
    IntegerTrie,
    Numbers,
    integer_trie,
    log_probabilities,
    stack_choices,
    stack_numbers,
)
from dsvla_jax.model.llama import KVCache
from dsvla_jax.model.unstacked import is_unstacked, stack_layers
from dsvla_jax.model.variables import Variables
from dsvla_jax.model.vla import VLA, extend, lm_head, prefill
from dsvla_jax.types import Array, ModelInputs, Text


@dataclasses.dataclass(frozen=True)
class Decoding:
    """How integers are chosen from their distributions.

    Attributes:
        choice: `greedy` takes the most probable integer of each slot; `expected` the one nearest to the mean of the
            slot's distribution; `sample` draws.
        temperature: of `sample`: the distributions are raised to its inverse.
        samples: of `sample`: so many answers are drawn, and the most probable one is kept.
    """

    choice: Literal["greedy", "expected", "sample"] = "greedy"
    temperature: float = 1.0
    samples: int = 1

    def __post_init__(self) -> None:
        if self.temperature <= 0 or self.samples < 1:
            raise ValueError(f"Decoding: expected temperature > 0 and samples >= 1, got {self}")
        if self.choice != "sample" and (self.temperature, self.samples) != (1.0, 1):
            raise ValueError(f"Decoding: temperature and samples belong to choice 'sample', not to {self.choice!r}")


GREEDY = Decoding()


@struct.dataclass
class Decoded:
    """The answers of a batch.

    integers: int32 (B, A, 8), as ``PoseCodec.decode`` takes them. log_probs: float32 (B, A, 8), of each among the
    integers that its slot admits. entropies: float32 (B, A, 8), nats, of the slots' distributions: how unsure the
    policy was. passes: how often the language model was run one after the other, the prompt's pass included.
    """

    integers: Array
    log_probs: Array
    entropies: Array
    passes: int = struct.field(pytree_node=False)


@struct.dataclass
class _Answer:
    """The answer as far as it goes: integers int32 (B, K), log_probs and entropies float32 (B, K)."""

    integers: Array
    log_probs: Array
    entropies: Array


@struct.dataclass
class _CacheState:
    """What the language model has read: its cache, valid bool (B, S) where that holds a token, lengths int32 (B,)."""

    cache: KVCache
    valid: Array
    lengths: Array


@struct.dataclass
class _DecodeStep:
    """What one pass reads, and how it leads to the number of a slot.

    slot: int32 (), which. offset: where in the cache it writes. before: the numbers of the slot before, of which it
    reads the chosen one. template: int32 (C,). tree: of the number to come.
    """

    slot: int | np.ndarray | Array
    offset: int | np.ndarray | Array
    before: Numbers
    template: np.ndarray | Array
    tree: IntegerTrie

    def shape(self) -> tuple[int, ...]:
        return self.before.tokens.shape[1], len(self.template), len(self.tree.branches.tokens)


def decode_actions(
    model: VLA,
    variables: Variables,
    inputs: ModelInputs[Array],
    grammar: AnswerGrammar,
    decoding: Decoding = GREEDY,
    key: Array | None = None,
) -> Decoded:
    """The answers of a batch. Under ``jax.jit``, close over the model, grammar and decoding (see ``make_decoder``).

    variables: of the model, or these from `unstack_layers`.
    inputs: batched, the text being prompts without answers, padded at the end to one length; padding and the other
        examples of the batch have no influence on an answer.
    key: for `sample`; an example draws by its place in the batch.
    """
    _check_vocabulary(grammar, model.config.language.vocab_size)
    if decoding.choice == "sample" and key is None:
        raise ValueError("decode_actions: choice 'sample' draws integers; give it a key")
    if is_unstacked(variables):
        layers = max(model.config.vision.layers, model.config.language.layers)
        model = VLA(dataclasses.replace(model.config, scan_unroll=layers))
    trees = [integer_trie(slot) for slot in grammar.slots]
    # What precedes the first number is read with the prompt; behind the last number nothing is read.
    inputs = _append(inputs, np.array(grammar.templates[0], np.int32))
    templates = [np.array(template, np.int32) for template in grammar.templates[1:-1]]
    # Number and template keep their places in the cache; those of a tree are used again by the next pass.
    kept = [tree.numbers.tokens.shape[1] + len(template) for tree, template in zip(trees, templates, strict=False)]
    offsets = np.cumsum([0, *kept])
    room = max(offset + len(tree.branches.tokens) for offset, tree in zip(offsets, trees, strict=True))

    root, cache = prefill(model, stack_layers(variables), inputs, int(room))
    before = cache.keys.shape[3] - room
    lengths = before - inputs.text.tokens.shape[1] + inputs.text.mask.sum(axis=1).astype(jnp.int32)
    if decoding.samples > 1:
        root, cache, lengths = _repeat((root, cache, lengths), decoding.samples)
    batch = len(lengths)
    keys = None if key is None else jax.vmap(lambda b: jax.random.fold_in(key, b))(jnp.arange(batch))
    read = _CacheState(cache, jnp.arange(cache.keys.shape[3]) < lengths[:, None], lengths)
    written = _Answer(*(jnp.zeros((batch, len(trees)), dtype) for dtype in (jnp.int32, jnp.float32, jnp.float32)))

    def choose(written: _Answer, slot: int | np.ndarray | Array, hidden: Array, tree: IntegerTrie) -> _Answer:
        logits = lm_head(model, stack_layers(variables), hidden, tree.choices.tokens)
        log_probs = _admitted(log_probabilities(logits, tree.choices), written, slot, tree.numbers)
        index = _choose(log_probs, tree.numbers, decoding, keys, slot)[:, None]
        entropy = -jnp.where(jnp.isfinite(log_probs), jnp.exp(log_probs) * log_probs, 0.0).sum(axis=-1)
        return _Answer(
            written.integers.at[:, slot].set(jnp.asarray(tree.numbers.values)[index[:, 0]]),
            written.log_probs.at[:, slot].set(jnp.take_along_axis(log_probs, index, axis=1)[:, 0]),
            written.entropies.at[:, slot].set(entropy),
        )

    def run(carry: tuple[_CacheState, _Answer], one: _DecodeStep) -> tuple[tuple[_CacheState, _Answer], None]:
        read, written = carry
        row = written.integers[:, one.slot - 1] - jnp.asarray(one.before.values)[0]
        number, length = jnp.asarray(one.before.tokens)[row], jnp.asarray(one.before.lengths)[row]
        index, branches = before + one.offset, one.tree.branches
        x, read = _extend(model, variables, read, index, number, length, one.template, branches)
        trunk = number.shape[1] + len(one.template)
        last = jnp.where(len(one.template) > 0, trunk, length) - 1
        root = jnp.take_along_axis(x, last[:, None, None], axis=1)
        written = choose(written, one.slot, jnp.concatenate([root, x[:, trunk:]], axis=1), one.tree)
        return (read, written), None

    passes, hidden = 1, root[:, None]
    if len(trees[0].branches.tokens):
        nothing = jnp.zeros((batch, 0), jnp.int32), jnp.zeros(batch, jnp.int32), np.zeros(0, np.int32)
        x, read = _extend(model, variables, read, before, *nothing, trees[0].branches)
        passes, hidden = passes + 1, jnp.concatenate([hidden, x], axis=1)
    carry = read, choose(written, 0, hidden, trees[0])
    following = [
        _DecodeStep(slot, offset, trees[slot - 1].numbers, template, trees[slot])
        for slot, offset, template in zip(range(1, len(trees)), offsets, templates, strict=False)
    ]
    # Neighbouring passes of one shape run as one loop, so that compile time does not grow with them.
    for _, alike in itertools.groupby(following, _DecodeStep.shape):
        group = list(alike)
        carry, _ = jax.lax.scan(run, carry, _stack(group))
        passes += len(group)
    written = carry[1]
    if decoding.samples > 1:
        written = _most_probable(written, decoding.samples)
    arms = (-1, grammar.num_arms, VALUES_PER_ARM)
    return Decoded(
        written.integers.reshape(arms), written.log_probs.reshape(arms), written.entropies.reshape(arms), passes
    )


def make_decoder(model: VLA, grammar: AnswerGrammar, decoding: Decoding = GREEDY) -> Callable[..., Decoded]:
    """A jitted ``(variables, inputs, key=None) -> Decoded`` for one grammar; only `sample` needs a key."""
    return jax.jit(lambda variables, inputs, key=None: decode_actions(model, variables, inputs, grammar, decoding, key))


def _extend(
    model: VLA,
    variables: Variables,
    read: _CacheState,
    index: int | Array,
    number: Array,
    length: Array,
    template: np.ndarray | Array,
    branches: Branches,
) -> tuple[Array, _CacheState]:
    """Reads a number (B, W), of which the first ``length`` (B,) tokens count, a template and a tree's branches.

    They are written at ``index`` of the cache. Returns the hidden states (B, W + C + F, width), and what has been read:
    number and template, the branches having served.
    """
    batch, width = number.shape
    trunk = width + len(template)
    tokens = jnp.concatenate([jnp.asarray(template), jnp.asarray(branches.tokens)])
    tokens = jnp.concatenate([number, jnp.broadcast_to(tokens, (batch, len(tokens)))], axis=1)
    # Positions behind the text so far: a short number leaves places of the cache empty, but no gap in positions.
    behind = jnp.concatenate([jnp.arange(len(template)), len(template) - 1 + jnp.asarray(branches.depths)])
    behind = jnp.concatenate(
        [jnp.broadcast_to(jnp.arange(width), (batch, width)), length[:, None] + behind.astype(jnp.int32)], axis=1
    )
    counts = (jnp.arange(trunk) < length[:, None]) | (jnp.arange(trunk) >= width)
    earlier = jnp.arange(tokens.shape[1])[:, None] >= jnp.arange(trunk)
    sees = jnp.pad(jnp.asarray(branches.sees), ((trunk, 0), (0, 0)))
    among = jnp.concatenate(
        [earlier & counts[:, None, :], jnp.broadcast_to(sees, (batch, *sees.shape))], axis=-1
    )  # (B, W + C + F, W + C + F)
    mask = jnp.broadcast_to(read.valid[:, None], (*tokens.shape, read.valid.shape[1]))
    mask = jax.lax.dynamic_update_slice_in_dim(mask, among, index, axis=2)
    positions = read.lengths[:, None] + behind
    x, cache = extend(model, stack_layers(variables), tokens, positions, mask, read.cache, index)
    valid = jax.lax.dynamic_update_slice_in_dim(read.valid, counts, index, axis=1)
    return x, _CacheState(cache, valid, read.lengths + length + len(template))


def _admitted(log_probs: Array, written: _Answer, slot: int | np.ndarray | Array, numbers: Numbers) -> Array:
    """Distributions (B, N) over integers, minus infinity exactly where none may be chosen, whatever the logits were.

    Besides rows that are no integer, that is 0 for the last part of a quaternion whose other parts are 0, which would
    be no rotation.
    """
    last, others = QUATERNION_VALUES.stop - 1, QUATERNION_VALUES.stop - 1 - QUATERNION_VALUES.start
    first = jnp.maximum(slot - others, 0)
    zeros = (jax.lax.dynamic_slice_in_dim(written.integers, first, others, axis=1) == 0).all(axis=1)
    refused = (jnp.asarray(slot) % VALUES_PER_ARM == last) & zeros[:, None] & (jnp.asarray(numbers.values) == 0)
    admitted = (jnp.asarray(numbers.lengths) > 0) & ~refused
    return jnp.where(admitted, jax.nn.log_softmax(jnp.where(admitted, log_probs, -jnp.inf), axis=-1), -jnp.inf)


def _choose(
    log_probs: Array, numbers: Numbers, decoding: Decoding, keys: Array | None, slot: int | np.ndarray | Array
) -> Array:
    """int32 (B,): rows of ``numbers``, never one of log-probability minus infinity."""
    if decoding.choice == "expected":
        values = jnp.asarray(numbers.values)
        mean = (jnp.exp(log_probs) * values).sum(axis=-1, keepdims=True)
        return jnp.where(jnp.isneginf(log_probs), jnp.inf, jnp.abs(values - mean)).argmin(axis=-1)
    if decoding.choice == "sample":
        draw = jax.vmap(lambda key, row: jax.random.categorical(jax.random.fold_in(key, slot), row))
        return draw(keys, log_probs / decoding.temperature)
    return log_probs.argmax(axis=-1)


def _stack(group: list[_DecodeStep]) -> _DecodeStep:
    """Passes of one shape in arrays with an axis in front."""
    branches = jax.tree.map(lambda *leaves: np.stack(leaves), *(one.tree.branches for one in group))
    return _DecodeStep(
        slot=np.array([one.slot for one in group], np.int32),
        offset=np.array([one.offset for one in group], np.int32),
        before=stack_numbers([one.before for one in group]),
        template=np.stack([one.template for one in group]),
        tree=IntegerTrie(
            branches,
            stack_choices([one.tree.choices for one in group]),
            stack_numbers([one.tree.numbers for one in group]),
        ),
    )


def _repeat(tree: tuple[Array, KVCache, Array], times: int) -> tuple[Array, KVCache, Array]:
    """Every example ``times`` times, side by side; (root, cache, lengths), of which the cache's axis 1 is the batch."""
    root, cache, lengths = tree
    prompt = cache.prompt
    if prompt is not None:
        prompt = dataclasses.replace(
            prompt, keys=jnp.repeat(prompt.keys, times, axis=1), values=jnp.repeat(prompt.values, times, axis=1)
        )
    cache = KVCache(jnp.repeat(cache.keys, times, axis=1), jnp.repeat(cache.values, times, axis=1), prompt)
    return jnp.repeat(root, times, axis=0), cache, jnp.repeat(lengths, times, axis=0)


def _most_probable(written: _Answer, samples: int) -> _Answer:
    """Of each example's samples the one of highest probability."""
    best = written.log_probs.sum(axis=1).reshape(-1, samples).argmax(axis=1)
    rows = jnp.arange(len(best)) * samples + best
    return jax.tree.map(lambda leaf: leaf[rows], written)


def _check_vocabulary(grammar: AnswerGrammar, vocab_size: int) -> None:
    numbers = (token for slot in grammar.slots for tokens in slot.tokens for token in tokens)
    largest = max(itertools.chain(numbers, *grammar.templates))
    if largest >= vocab_size:
        raise ValueError(
            f"grammar: made for another vocabulary, in which an answer has token {largest}; the model has {vocab_size} "
            "tokens. Build both from one tokenizer"
        )


def _append(inputs: ModelInputs, tokens: np.ndarray) -> ModelInputs:
    """The prompts with ``tokens`` after each one's last valid token, still padded at the end."""
    count = tokens.shape[0]
    if count == 0:
        return inputs
    text = jnp.pad(inputs.text.tokens, ((0, 0), (0, count)))
    behind = jnp.arange(text.shape[1])[None] - inputs.text.mask.sum(axis=1, keepdims=True)
    text = jnp.where((behind >= 0) & (behind < count), jnp.asarray(tokens)[jnp.clip(behind, 0, count - 1)], text)
    return dataclasses.replace(inputs, text=Text(text, behind < count))
