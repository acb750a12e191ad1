"""Decoding: against the full forward pass, independence of batch-mates, well-formed answers, ways to choose."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dsvla_jax.encoding.grammar import build_answer_grammar
from dsvla_jax.encoding.prompts import format_answer, parse_answer
from dsvla_jax.model.config import LanguageConfig, LoraConfig, ModelConfig, VisionConfig
from dsvla_jax.model.decode import Decoding, decode_actions, make_decoder
from dsvla_jax.model.unstacked import stack_layers, unstack_layers
from dsvla_jax.model.vla import VLA, extend, initialize, lm_head, prefill
from dsvla_jax.types import ModelInputs
from tests.decoding import (
    check_against_the_full_forward_pass,
    check_padding_and_batch_mates,
    decoder,
    small_grammar,
    whole_number_grammar,
)
from tests.random_data import random_inputs
from tests.vocabularies import small_tokenizer

VOCAB = 40
CONFIG = ModelConfig(
    vision=VisionConfig(image_size=16, patch_size=8, width=32, layers=1, heads=4),
    language=LanguageConfig(vocab_size=VOCAB, width=32, layers=2, heads=4, kv_heads=2, ffn=48),
    lora=LoraConfig(rank=2, alpha=5.0),
)
GRAMMAR, WHOLE = small_grammar(), whole_number_grammar()
PROMPT_LENGTHS = np.array([9, 4, 1])


def make_prompts(lengths=PROMPT_LENGTHS, padded=9, seed=0) -> ModelInputs:
    return random_inputs(CONFIG.vision, range(10, VOCAB), lengths, padded, points=3, seed=seed)


def random_variables(config: ModelConfig):
    variables = jax.jit(lambda: initialize(config, jax.random.key(0)))()
    keys = jax.random.key(7)
    return {
        "params": jax.tree.map(lambda x: x * 2.0, variables["params"]),
        "lora": jax.tree.map(lambda x: x + 0.1 * jax.random.normal(keys, x.shape), variables["lora"]),
    }


@pytest.fixture(scope="module")
def variables():
    return random_variables(CONFIG)


def always(token_logits: dict[int, float]):
    """Variables of a model that has the same logits after any text."""
    shapes = jax.eval_shape(lambda: initialize(CONFIG, jax.random.key(0)))
    variables = jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), shapes)
    params = variables["params"]
    params["language"]["norm"]["scale"] += 1
    params["language"]["embedding"] += 1
    for token, logit in token_logits.items():
        params["language"]["output"][:, token] = logit / 32
    return variables


def test_decoding_is_the_best_choice_of_the_full_forward_pass(variables):
    check_against_the_full_forward_pass(CONFIG, GRAMMAR, variables, make_prompts())


def test_prefill_and_extend_give_the_logits_of_the_full_forward_pass(variables):
    model, prompts = VLA(CONFIG), make_prompts(np.array([9, 9]))
    full = jax.jit(model.apply)(variables, prompts)
    extended = jax.jit(lambda *args: extend(model, variables, *args))
    logits = jax.jit(lambda *args: lm_head(model, variables, *args))
    head = dataclasses.replace(prompts, text=jax.tree.map(lambda x: x[:, :4], prompts.text))
    hidden, cache = jax.jit(lambda head: prefill(model, variables, head, 5))(head)
    np.testing.assert_allclose(logits(hidden), full[:, 3], atol=1e-4)
    slots = cache.keys.shape[3]
    start = slots - 5
    for first, count in ((4, 2), (6, 1), (7, 1)):
        positions = start - 4 + first + jnp.arange(count)[None].repeat(2, axis=0)
        mask = jnp.arange(slots) <= positions[..., None]
        chunk = prompts.text.tokens[:, first : first + count]
        hidden, cache = extended(chunk, positions, mask, cache, start - 4 + first)
        np.testing.assert_allclose(logits(hidden), full[:, first : first + count], atol=1e-4)
    some = np.array([3, 17, 5])
    np.testing.assert_allclose(logits(hidden, some), full[:, 7:8, some], atol=1e-4)


def test_padding_and_batch_mates_never_change_an_answer(variables):
    check_padding_and_batch_mates(CONFIG, GRAMMAR, variables, make_prompts(), make_prompts(seed=5), PROMPT_LENGTHS)


@pytest.mark.parametrize(
    ("kind", "arms", "style"),
    [("words", 2, "compact"), ("sentencepiece", 1, "paper"), ("merged", 1, "compact")],
)
def test_random_weights_give_well_formed_actions(kind, arms, style):
    tokenizer = small_tokenizer(kind)
    language = dataclasses.replace(CONFIG.language, vocab_size=tokenizer.vocab_size)
    config = dataclasses.replace(CONFIG, language=language)
    variables, grammar = random_variables(config), build_answer_grammar(tokenizer, arms, style)
    decode = make_decoder(VLA(config), grammar)
    seen = set()
    for seed in range(3):
        lengths = np.random.default_rng(seed).integers(1, 10, 25)
        weights = jax.tree.map(lambda x, s=seed: x * (1.0 + 3 * s), variables)
        decoded = decode(weights, make_prompts(lengths, seed=seed))
        assert np.isfinite(decoded.log_probs).all()
        assert (np.asarray(decoded.entropies) > -1e-5).all()
        # A choice of signs and digits, at most, is one pass; template tokens and the end are none.
        assert decoded.passes <= 1 + 8 * arms
        for integers in np.asarray(decoded.integers):
            text = tokenizer.decode(grammar.tokens(integers))
            np.testing.assert_array_equal(parse_answer(text, arms, style), integers)
            seen.add(format_answer(integers, style))
    assert len(seen) > 20


@pytest.mark.parametrize("choice", ["greedy", "expected", "sample"])
def test_not_even_broken_weights_give_a_malformed_action(choice: Any):
    grammar = GRAMMAR if choice == "greedy" else WHOLE
    decode = decoder(CONFIG, grammar, Decoding(choice))
    for value in (np.nan, np.inf, -np.inf, 1e30):
        broken = always(dict.fromkeys(range(VOCAB), value))
        decoded = decode(broken, make_prompts(), jax.random.key(0))
        for row in np.asarray(decoded.integers):
            assert all(value in slot.values for value, slot in zip(row.ravel(), grammar.slots, strict=True))
            assert row[0, 3:7].any()


def test_a_rotation_of_zeros_never_comes_out():
    # Numbers 3, 4 and 6 are "0" and number 5 its integer 0: the next best integer of number 6 is 9.
    zero = always({10: 90.0, 21: 80.0, 4: 80.0, 6: 80.0, 7: 80.0, 19: 60.0})
    decoded = decoder(CONFIG, GRAMMAR)(zero, make_prompts())
    np.testing.assert_array_equal(decoded.integers[:, 0, 3:7], [[0, 0, 0, 9]] * 3)
    assert np.isfinite(decoded.log_probs).all()


def test_expected_is_the_mean_of_the_distribution():
    # Number 2 is -2, -1, 0, 1 or 2, with weights 4, 0, 1, 3, 3: the best is -2, the mean 1/11.
    weights = {20 + n: float(np.log(w)) for n, w in enumerate((4.0, 1e-6, 1.0, 3.0, 3.0))}
    for choice, expected in ((Decoding("greedy"), -2), (Decoding("expected"), 0)):
        decoded = decoder(CONFIG, WHOLE, choice)(always(weights), make_prompts())
        assert (np.asarray(decoded.integers[:, 0, 2]) == expected).all()
    np.testing.assert_allclose(decoded.log_probs[:, 0, 2], np.log(1 / 11), atol=1e-3)
    p = np.array([4, 1, 3, 3]) / 11
    np.testing.assert_allclose(decoded.entropies[:, 0, 2], -(p * np.log(p)).sum(), atol=1e-3)


def test_samples_follow_the_distribution_and_the_key():
    decode = decoder(CONFIG, WHOLE, Decoding("sample"))
    model, prompts = always({20: float(np.log(6.0))}), make_prompts(np.full(400, 9))
    drawn = decode(model, prompts, jax.random.key(0))
    # Number 2: -2 with weight 6, four others with weight 1.
    share = (np.asarray(drawn.integers[:, 0, 2]) == -2).mean()
    assert abs(share - 0.6) < 4 * np.sqrt(0.6 * 0.4 / 400)
    np.testing.assert_array_equal(decode(model, prompts, jax.random.key(0)).integers, drawn.integers)
    assert (np.asarray(decode(model, prompts, jax.random.key(1)).integers) != drawn.integers).any()
    cold = decoder(CONFIG, WHOLE, Decoding("sample", temperature=0.05))
    assert (np.asarray(cold(model, prompts, jax.random.key(0)).integers[:, 0, 2]) == -2).all()


def test_the_best_of_several_samples_is_kept(variables):
    prompts, key = make_prompts(), jax.random.key(3)
    one = decoder(CONFIG, WHOLE, Decoding("sample"))(variables, prompts, key)
    best = decoder(CONFIG, WHOLE, Decoding("sample", samples=20))(variables, prompts, key)
    gained = best.log_probs.sum((1, 2)) - one.log_probs.sum((1, 2))
    assert (gained > -1e-4).all(), "at worst the same answer, but for rounding"
    assert (gained > 1).any()
    assert best.integers.shape == one.integers.shape


def test_choosing_says_what_it_needs(variables):
    with pytest.raises(ValueError, match="give it a key"):
        decode_actions(VLA(CONFIG), variables, make_prompts(), GRAMMAR, Decoding("sample"))
    with pytest.raises(ValueError, match="temperature > 0"):
        Decoding("sample", temperature=0.0)
    with pytest.raises(ValueError, match="belong to choice 'sample'"):
        Decoding("greedy", samples=4)
    small = dataclasses.replace(CONFIG, language=dataclasses.replace(CONFIG.language, vocab_size=30))
    with pytest.raises(ValueError, match=r"has token 34; the model has 30"):
        decode_actions(VLA(small), variables, make_prompts(), GRAMMAR)


def test_weights_taken_apart_give_the_same_answers(variables):
    apart = unstack_layers(variables)
    jax.tree.map(np.testing.assert_array_equal, stack_layers(apart), variables)
    whole, parts = (decoder(CONFIG, GRAMMAR)(weights, make_prompts()) for weights in (variables, apart))
    np.testing.assert_array_equal(whole.integers, parts.integers)
    np.testing.assert_allclose(whole.log_probs, parts.log_probs, atol=1e-4)


def test_weights_taken_apart_are_never_stacked_in_memory(variables):
    layers, width, ffn = CONFIG.language.layers, CONFIG.language.width, CONFIG.language.ffn
    stacks = f"f32[{layers},{width},{ffn}]", f"f32[{layers},{ffn},{width}]"
    programs = [decoder(CONFIG, GRAMMAR).lower(w, make_prompts()) for w in (variables, unstack_layers(variables))]  # pyright: ignore[reportFunctionMemberAccess]
    whole, parts = (program.compile().as_text() for program in programs)
    assert all(stack in whole for stack in stacks)
    assert not any(stack in parts for stack in stacks)
