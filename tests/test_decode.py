"""Decoding: the cache against the full forward pass, independence of batch-mates, well-formed answers."""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dsvla_jax.encoding.prompts import STYLES, parse_answer
from dsvla_jax.encoding.text import WordTokenizer, build_answer_grammar, vocabulary
from dsvla_jax.model.config import LanguageConfig, LoraConfig, ModelConfig, VisionConfig
from dsvla_jax.model.decode import decode_actions, make_decoder
from dsvla_jax.model.vla import VLA, initialize
from dsvla_jax.types import ModelInputs
from tests.decoding import check_padding_and_batch_mates

TOKENIZER = WordTokenizer(vocabulary([]))
VOCAB = TOKENIZER.vocab_size
EOS = TOKENIZER.eos_id
CONFIG = ModelConfig(
    vision=VisionConfig(image_size=16, patch_size=8, width=32, layers=1, heads=4),
    language=LanguageConfig(vocab_size=VOCAB, width=32, layers=2, heads=4, kv_heads=2, ffn=48),
    lora=LoraConfig(rank=2, alpha=5.0),
)
# Template tokens in front, single and double ones between free slots, adjacent free slots, and the end.
FORCED = np.array([5, 6, -1, 7, -1, 7, -1, 8, 9, -1, -1, EOS], np.int32)
PROMPT_LENGTHS = np.array([9, 4, 1])


class Grammar(NamedTuple):
    forced: np.ndarray
    allowed: np.ndarray
    forbidden: np.ndarray = np.zeros((0, 1), np.int32)


def make_grammar(forced=FORCED, seed=0):
    allowed = np.random.default_rng(seed).random((len(forced), VOCAB)) < 0.4
    return Grammar(forced, allowed, np.zeros((0, len(forced)), np.int32))


def make_prompts(lengths=PROMPT_LENGTHS, padded=9, seed=0) -> ModelInputs:
    rng = np.random.default_rng(seed)
    batch = len(lengths)
    return ModelInputs(
        image=jnp.asarray(rng.normal(size=(batch, 16, 16, 3)), jnp.float32),
        point_tokens=jnp.asarray(rng.normal(size=(batch, 3, 32)), jnp.float32),
        point_patches=jnp.asarray(rng.integers(0, 4, (batch, 3)), jnp.int32),
        text_tokens=jnp.asarray(rng.integers(10, VOCAB, (batch, padded)), jnp.int32),
        text_mask=jnp.arange(padded)[None] < jnp.asarray(lengths)[:, None],
    )


@pytest.fixture(scope="module")
def variables():
    variables = initialize(CONFIG, jax.random.key(0))
    keys = jax.random.key(7)
    return {
        "params": jax.tree.map(lambda x: x * 2.0, variables["params"]),
        "lora": jax.tree.map(lambda x: x + 0.1 * jax.random.normal(keys, x.shape), variables["lora"]),
    }


def teacher_forced_logits(variables, prompts, answers):
    """The full forward pass over prompt + answer: logits (B, L, V) that predict each answer token."""
    lengths = np.asarray(prompts.text_mask.sum(axis=1))
    texts = np.zeros((len(lengths), lengths.max() + answers.shape[1]), np.int32)
    for row, prompt, length, answer in zip(texts, np.asarray(prompts.text_tokens), lengths, answers, strict=True):
        row[: length + len(answer)] = [*prompt[:length], *answer]
    inputs = dataclasses.replace(prompts, text_tokens=jnp.asarray(texts), text_mask=jnp.ones(texts.shape, bool))
    logits = jax.jit(VLA(CONFIG).apply)(variables, inputs)
    return jnp.stack([row[n - 1 : n - 1 + answers.shape[1]] for row, n in zip(logits, lengths, strict=True)])


@pytest.mark.parametrize("forced", [FORCED, np.array([-1, -1, 4, -1, 4, -1], np.int32)])
def test_decoding_is_the_greedy_choice_of_the_full_forward_pass(variables, forced):
    grammar, prompts = make_grammar(forced), make_prompts()
    tokens, log_probs = make_decoder(VLA(CONFIG), grammar)(variables, prompts)
    logits = teacher_forced_logits(variables, prompts, tokens)
    masked = jnp.where(grammar.allowed, logits, -jnp.inf)
    expected = jnp.where(forced >= 0, forced, masked.argmax(axis=-1))
    np.testing.assert_array_equal(tokens, expected)
    reference = jnp.take_along_axis(jax.nn.log_softmax(masked), tokens[..., None], axis=-1)[..., 0]
    np.testing.assert_allclose(log_probs, jnp.where(forced >= 0, 0.0, reference), atol=1e-4)


def test_prefill_and_extend_give_the_logits_of_the_full_forward_pass(variables):
    model, prompts = VLA(CONFIG), make_prompts(np.array([9, 9]))
    full = jax.jit(model.apply)(variables, prompts)
    extend = jax.jit(lambda *args: model.apply(variables, *args, method="extend"))
    head = dataclasses.replace(prompts, text_tokens=prompts.text_tokens[:, :4], text_mask=prompts.text_mask[:, :4])
    logits, cache = jax.jit(lambda head: model.apply(variables, head, 5, method="prefill"))(head)
    np.testing.assert_allclose(logits, full[:, 3], atol=1e-4)
    slots = cache.keys.shape[3]
    start = slots - 5
    for first, count in ((4, 2), (6, 1), (7, 1)):
        positions = start - 4 + first + jnp.arange(count)[None].repeat(2, axis=0)
        mask = jnp.arange(slots) <= positions[..., None]
        chunk = prompts.text_tokens[:, first : first + count]
        logits, cache = extend(chunk, positions, mask, cache, start - 4 + first)
        np.testing.assert_allclose(logits, full[:, first + count - 1], atol=1e-4)


def test_padding_and_batch_mates_never_change_an_answer(variables):
    check_padding_and_batch_mates(
        CONFIG, make_grammar(), variables, make_prompts(), make_prompts(seed=5), PROMPT_LENGTHS
    )


@pytest.mark.parametrize("style", STYLES)
def test_random_weights_give_well_formed_actions(variables, style):
    arms = {"compact": 1, "paper": 2}[style]
    decode = make_decoder(VLA(CONFIG), build_answer_grammar(TOKENIZER, arms, style))
    seen = set()
    for seed in range(5):
        lengths = np.random.default_rng(seed).integers(1, 10, 100)
        weights = jax.tree.map(lambda x, s=seed: x * (1.0 + s), variables)
        for answer in np.asarray(decode(weights, make_prompts(lengths, seed=seed))[0]):
            assert answer[-1] == EOS
            seen.add(parse_answer(TOKENIZER.decode(answer), arms, style).tobytes())
    assert len(seen) > 50


def test_forbidden_combinations_never_come_out(variables):
    # An embedding that always answers "0" wherever that is allowed.
    zero = TOKENIZER.encode("0")[0]
    params = jax.tree.map(jnp.zeros_like, variables["params"])
    params["language"]["norm"]["scale"] = jnp.ones(32)
    params["language"]["embedding"] = jnp.ones((VOCAB, 32))
    params["language"]["output"] = jnp.zeros((32, VOCAB)).at[:, zero].set(1.0).at[:, zero + 9].set(0.5)
    grammar = build_answer_grammar(TOKENIZER, 1, "compact")
    tokens, log_probs = make_decoder(VLA(CONFIG), grammar)({"params": params}, make_prompts())
    expected = np.zeros((1, 8), int)
    expected[0, 6] = 9
    for answer in np.asarray(tokens):
        np.testing.assert_array_equal(parse_answer(TOKENIZER.decode(answer), 1, "compact"), expected)
    assert np.isfinite(log_probs).all()


def test_a_template_without_free_slots_costs_nothing():
    tokens, log_probs = decode_actions(VLA(CONFIG), {}, make_prompts(), make_grammar(np.array([4, 5, EOS])))
    np.testing.assert_array_equal(tokens, np.tile([4, 5, EOS], (3, 1)))
    assert not log_probs.any()


@pytest.mark.parametrize(
    ("grammar", "message"),
    [
        (Grammar(np.array([-1]), np.ones((1, 7), bool)), "vocabulary of 7 tokens"),
        (Grammar(np.array([-1]), np.zeros((1, VOCAB), bool)), r"free slots \[0\]"),
        (Grammar(np.array([-1]), np.ones((2, VOCAB), bool)), "expected forced"),
    ],
)
def test_impossible_grammars_say_why(variables, grammar, message):
    with pytest.raises(ValueError, match=message):
        decode_actions(VLA(CONFIG), variables, make_prompts(), grammar)
