"""Visual tokens as gated prompts of the language model's layers, against NumPy, and what must not depend on them."""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dsvla_jax.model.config import LanguageConfig, LoraConfig, ModelConfig, VisionConfig, VisualPromptConfig
from dsvla_jax.model.llama import Llama
from dsvla_jax.model.lora import merge_lora
from dsvla_jax.model.vla import VLA, extend, initialize, lm_head, prefill
from dsvla_jax.types import ModelInputs
from tests.decoding import check_against_the_full_forward_pass, check_padding_and_batch_mates, small_grammar
from tests.random_data import random_inputs

VOCAB = 40
CONFIG = ModelConfig(
    vision=VisionConfig(image_size=16, patch_size=8, width=32, layers=1, heads=4, embed_width=24),
    language=LanguageConfig(vocab_size=VOCAB, width=32, layers=3, heads=4, kv_heads=2, ffn=48),
    fusion="adapter",
    visual_prompt=VisualPromptConfig(width=32, layers=2, heads=2, ffn=40, prompted_layers=2),
    lora=LoraConfig(rank=2, alpha=5.0),
)
PROMPTS = CONFIG.visual_prompt
# All layers prompted by every visual token (ManipLLM), the last two of them, and learned queries (LLaMA-Adapter V2).
VARIANTS = {
    "last": CONFIG,
    "all": dataclasses.replace(CONFIG, visual_prompt=dataclasses.replace(PROMPTS, prompted_layers=None)),
    "queries": dataclasses.replace(CONFIG, visual_prompt=dataclasses.replace(PROMPTS, queries=3)),
}
LENGTHS = np.array([7, 4, 1])


def make_inputs(lengths=(8, 8), points=3, seed=0) -> ModelInputs:
    return random_inputs(CONFIG.vision, range(VOCAB), np.array(lengths), max(lengths), points, seed)


def opened(config: ModelConfig) -> dict[str, Any]:
    """Random variables with open gates of both signs, rows that count, and adapters that do something."""
    rng = np.random.default_rng(1)

    def fill(path, leaf):
        name, noise = path[-1].key, rng.normal(size=leaf.shape)
        scale = {"gate": 3.0, "adapter_query": 1.0, "a": 0.2, "b": 0.2, "bias": 0.1, "scale": 0.1}
        value = noise * scale.get(name, leaf.shape[-2] ** -0.5 if leaf.ndim > 1 else 1.0)
        return jnp.asarray(value + (name == "scale"), jnp.float32)

    return jax.tree_util.tree_map_with_path(fill, jax.eval_shape(lambda: initialize(config, jax.random.key(0))))


@pytest.fixture(scope="module", params=VARIANTS)
def case(request) -> tuple[ModelConfig, dict[str, Any]]:
    config = VARIANTS[request.param]
    return config, opened(config)


@pytest.fixture(scope="module")
def variables() -> dict[str, Any]:
    return opened(CONFIG)


@pytest.fixture(scope="module")
def forward():
    return jax.jit(VLA(CONFIG).apply)


# The oracle: one example at a time, float64, no code of the model


class Blocks(NamedTuple):
    """A stack of LLaMA layers: base weights, adapters, sizes."""

    params: Any
    lora: Any
    scale: float
    heads: int
    kv_heads: int
    theta: float
    epsilon: float


def rms(x, scale, epsilon):
    return x / np.sqrt((x**2).mean(-1, keepdims=True) + epsilon) * scale


def layer_norm(x, params):
    x = (x - x.mean(-1, keepdims=True)) / np.sqrt(x.var(-1, keepdims=True) + 1e-5)
    return x * params["scale"] + params["bias"]


def softmax_attention(query, key, value, causal):
    scores = key @ query.T / np.sqrt(query.shape[1])  # (S, T)
    if causal:
        scores[np.tril_indices(len(key), -1)] = -np.inf
    weights = np.exp(scores - scores.max(0))
    return (weights / weights.sum(0)).T @ value


def rotary(x, positions, theta):
    half = x.shape[1] // 2
    turns = np.exp(1j * positions[:, None] * theta ** (-np.arange(half) / half))
    turned = (x[:, :half] + 1j * x[:, half:]) * turns
    return np.concatenate([turned.real, turned.imag], axis=1)


def run_blocks(x, positions, blocks: Blocks, causal, prompts=None):
    """prompts: one (tokens (P, width), gate (heads,)) a layer, or None."""
    for i in range(len(blocks.params["q"]["kernel"])):

        def linear(name, x, adapted=True, i=i):
            y = x @ blocks.params[name]["kernel"][i]
            if adapted and name in blocks.lora:
                y = y + blocks.scale * x @ blocks.lora[name]["a"][i] @ blocks.lora[name]["b"][i]
            return y

        y = rms(x, blocks.params["attention_norm"]["scale"][i], blocks.epsilon)
        query = np.split(linear("q", y), blocks.heads, axis=1)
        key, value = (np.split(linear(name, y), blocks.kv_heads, axis=1) for name in "kv")
        outputs = []
        for head in range(blocks.heads):
            group = head // (blocks.heads // blocks.kv_heads)
            turned = rotary(query[head], positions, blocks.theta)
            output = softmax_attention(turned, rotary(key[group], positions, blocks.theta), value[group], causal)
            if prompts is not None and prompts[i] is not None:
                tokens, gate = prompts[i]
                prompt_key, prompt_value = (
                    np.split(linear(name, tokens, adapted=False), blocks.kv_heads, axis=1)[group] for name in "kv"
                )
                output = output + np.tanh(gate[head]) * softmax_attention(turned, prompt_key, prompt_value, False)
            outputs.append(output)
        x = x + linear("o", np.concatenate(outputs, axis=1))
        y = rms(x, blocks.params["mlp_norm"]["scale"][i], blocks.epsilon)
        gate = linear("gate", y)
        x = x + linear("down", gate / (1 + np.exp(-gate)) * linear("up", y))
    return x


def oracle_logits(config: ModelConfig, variables, inputs: ModelInputs) -> np.ndarray:
    params, lora = jax.tree.map(lambda x: np.asarray(x, np.float64), (variables["params"], variables["lora"]))
    outputs = np.asarray(VLA(config).apply(variables, inputs, method="encode_vision"), np.float64)
    language, settings, p = config.language, config.visual_prompt, params["projector"]
    visual = Blocks(p["visual_blocks"], {}, 0.0, settings.heads, settings.heads, settings.rope_theta, settings.norm_eps)
    decoder = Blocks(
        params["language"]["layers"],
        lora["language"]["layers"],
        5.0 / 2,
        language.heads,
        language.kv_heads,
        language.rope_theta,
        language.norm_eps,
    )
    results = []
    for seen, patches, text in zip(
        outputs, np.asarray(inputs.point_patches), np.asarray(inputs.text.tokens), strict=True
    ):
        x = layer_norm(seen @ p["clip_proj"]["kernel"] + p["clip_proj"]["bias"], p["clip_proj_norm"])
        rows = np.array([*range(5), *(1 + patches)])
        positions = rows
        if settings.queries:
            x = np.concatenate([p["visual_query"], x])
            positions = np.concatenate([np.arange(3), 3 + rows])
            rows = np.arange(3)
        x = run_blocks(x, positions, visual, causal=False)[: len(rows)]
        x = rms(x, p["visual_blocks_norm"]["scale"], settings.norm_eps) @ p["visual_blocks_output"]["kernel"]
        x = layer_norm(x @ p["visual_proj"]["kernel"] + p["visual_proj"]["bias"], p["visual_proj_norm"])
        prompts = [(x + own[rows], gate) for own, gate in zip(p["adapter_query"], p["gate"], strict=True)]
        prompts = [None] * (language.layers - len(prompts)) + prompts
        x = run_blocks(params["language"]["embedding"][text], np.arange(len(text)), decoder, True, prompts)
        results.append(rms(x, params["language"]["norm"]["scale"], language.norm_eps) @ params["language"]["output"])
    return np.stack(results)


def test_logits_are_text_attention_plus_gated_prompt_attention(case):
    config, variables = case
    inputs = make_inputs()
    expected = oracle_logits(config, variables, inputs)
    logits = jax.jit(VLA(config).apply)(variables, inputs)
    np.testing.assert_allclose(logits, expected, atol=1e-4 * np.abs(expected).max())


def test_gate_of_zero_leaves_the_language_model_alone():
    variables = initialize(CONFIG, jax.random.key(0))
    assert not variables["params"]["projector"]["gate"].any()
    inputs = make_inputs()
    forward = jax.jit(VLA(CONFIG).apply)
    logits = forward(variables, inputs)
    for changed in (
        dataclasses.replace(inputs, images=inputs.images * 3 + 1),
        dataclasses.replace(inputs, point_tokens=-inputs.point_tokens),
        dataclasses.replace(inputs, point_patches=3 - inputs.point_patches),
        make_inputs(points=0),
    ):
        changed = dataclasses.replace(changed, text=inputs.text)
        np.testing.assert_array_equal(forward(variables, changed), logits)

    def language_model(model: Llama, tokens):
        positions = jnp.arange(tokens.shape[1])[None]
        hidden, _ = model(model.embed(tokens), positions, positions[:, :, None] >= positions[:, None])
        return model.lm_head(hidden)

    own = {name: variables[name]["language"] for name in ("params", "lora")}
    alone: Any = Llama(CONFIG).apply(own, inputs.text.tokens, method=language_model)
    np.testing.assert_allclose(logits, alone, atol=1e-5)


def test_open_gate_lets_image_and_cloud_through(forward, variables):
    inputs = make_inputs()
    logits = forward(variables, inputs)
    for changed in (
        dataclasses.replace(inputs, images=inputs.images + 1.0),
        dataclasses.replace(inputs, point_tokens=inputs.point_tokens * 2),
        dataclasses.replace(inputs, point_patches=3 - inputs.point_patches),
    ):
        assert np.abs(forward(variables, changed) - logits).max() > 1e-3


def test_order_of_3d_tokens_means_nothing(forward, variables):
    inputs = make_inputs()
    order = np.array([2, 0, 1])
    permuted = dataclasses.replace(
        inputs, point_tokens=inputs.point_tokens[:, order], point_patches=inputs.point_patches[:, order]
    )
    np.testing.assert_allclose(forward(variables, permuted), forward(variables, inputs), atol=1e-4)


def test_adapters_that_the_prompt_does_not_see_are_not_merged(forward, variables):
    with pytest.raises(ValueError, match=r"adapters of k and v .* cannot be merged"):
        merge_lora(variables, LoraConfig(rank=2, alpha=5.0))
    layers = {name: variables["lora"]["language"]["layers"][name] for name in ("q", "o", "up")}
    without = {**variables, "lora": {**variables["lora"], "language": {"layers": layers}}}
    merged = merge_lora(without, LoraConfig(rank=2, alpha=5.0))
    expected = forward(without, make_inputs())
    np.testing.assert_allclose(forward(merged, make_inputs()), expected, atol=1e-4 * np.abs(expected).max())


@pytest.mark.parametrize("change", [{"remat": "full"}, {"attention": "fused", "scan_unroll": 2}])
def test_execution_switches_change_nothing(change, variables):
    def gradient(config):
        @jax.jit
        def run(projector, inputs):
            def loss(projector):
                tree = {**variables, "params": {**variables["params"], "projector": projector}}
                logits: Any = VLA(config).apply(tree, inputs)
                return jnp.square(logits).mean()

            return jax.value_and_grad(loss)(projector)

        return run(variables["params"]["projector"], make_inputs())

    expected, actual = gradient(CONFIG), gradient(dataclasses.replace(CONFIG, **change))
    assert all(np.abs(leaf).max() > 0 for leaf in jax.tree.leaves(expected[1]["gate"]))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5, rtol=1e-4), expected, actual)


# Decoding


def test_decoding_is_the_best_choice_of_the_full_forward_pass(case):
    config, variables = case
    check_against_the_full_forward_pass(config, small_grammar(), variables, make_inputs(LENGTHS))


def test_prefill_makes_the_prompts_keys_once_and_extend_keeps_them(variables):
    model, inputs = VLA(CONFIG), make_inputs()
    full = jax.jit(model.apply)(variables, inputs)
    head = dataclasses.replace(inputs, text=jax.tree.map(lambda x: x[:, :4], inputs.text))
    hidden, cache = jax.jit(lambda head: prefill(model, variables, head, 4))(head)
    logits = jax.jit(lambda hidden: lm_head(model, variables, hidden))
    np.testing.assert_allclose(logits(hidden), full[:, 3], atol=1e-4)
    assert cache.keys.shape == (3, 2, 2, 8, 8), "the text alone has slots"
    assert cache.prompt.keys.shape == (3, 2, 2, 5 + 3, 8)
    before = cache.prompt
    extended = jax.jit(lambda *args: extend(model, variables, *args))
    for place in range(4, 8):
        positions = jnp.full((2, 1), place)
        mask = jnp.arange(8) <= positions[..., None]
        hidden, cache = extended(inputs.text.tokens[:, place : place + 1], positions, mask, cache, place)
        np.testing.assert_allclose(logits(hidden[:, 0]), full[:, place], atol=1e-4)
    jax.tree.map(np.testing.assert_array_equal, cache.prompt, before)


def test_padding_and_batch_mates_never_change_an_answer(variables):
    check_padding_and_batch_mates(
        CONFIG, small_grammar(), variables, make_inputs(LENGTHS), make_inputs(LENGTHS, seed=5), LENGTHS
    )


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: dataclasses.replace(CONFIG, fusion="adaptor"),
            "expected one of prefix, adapter, got 'adaptor'",
        ),
        (
            lambda: dataclasses.replace(CONFIG, projector="mlp"),
            "projector: expected 'linear' with fusion 'adapter'",
        ),
        (
            lambda: VisualPromptConfig(width=33),
            r"width: expected a multiple of 2 \* heads = 16, got 33",
        ),
        (lambda: VisualPromptConfig(queries=-1), "model.visual_prompt.queries: expected at least 0, got -1"),
        (lambda: VisualPromptConfig(layers=0), "model.visual_prompt.layers: expected at least 1, got 0"),
        (
            lambda: dataclasses.replace(CONFIG, visual_prompt=VisualPromptConfig(prompted_layers=4)),
            "prompted_layers: expected at most the language model's 3 layers, got 4",
        ),
    ],
)
def test_impossible_configs_say_why(make, message):
    with pytest.raises(ValueError, match=message):
        make()
