"""The objective, the two regimes and checkpoints, on models small enough to train in a second."""

import dataclasses
import math
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from dsvla_jax.encoding.encode import encode_text
from dsvla_jax.encoding.grammar import build_answer_grammar
from dsvla_jax.encoding.number_targets import number_rows
from dsvla_jax.encoding.prompts import format_answer, format_prompt
from dsvla_jax.encoding.text import Tokenizer
from dsvla_jax.errors import UserError
from dsvla_jax.experiment import Experiment, OptimizerConfig, load_experiment, save_experiment
from dsvla_jax.model.config import LoraConfig, ModelConfig, VisualPromptConfig
from dsvla_jax.model.variables import join_variables, split_variables
from dsvla_jax.model.vla import initialize
from dsvla_jax.policies.answer_loss import answer_loss
from dsvla_jax.training.state import make_optimizer, start_state
from dsvla_jax.types import Example
from tests.learning import NO_NUMBERS, step_of
from tests.random_data import random_example, text_example
from tests.small import small_encoding, small_language, small_vision
from tests.vocabularies import KINDS, small_tokenizer

VOCABULARY = 40


def small_experiment(**changes) -> Experiment:
    return Experiment(
        encoding=small_encoding(max_text_length=16),
        model=ModelConfig(
            vision=small_vision(),
            language=small_language(VOCABULARY, 2),
            lora=LoraConfig(rank=2),
        ),
        steps=10,
        batch_size=4,
        **changes,
    )


def random_batch(experiment: Experiment) -> Example[np.ndarray]:
    place = np.arange(experiment.encoding.max_text_length)
    answer = np.tile((place >= 8) & (place < 12), (experiment.batch_size, 1))
    return random_example(np.random.default_rng(0), answer, VOCABULARY)


def train(experiment: Experiment, steps: int):
    variables = initialize(experiment.model, jax.random.key(0))
    trainable, frozen = split_variables(variables, experiment.regime)
    optimizer = make_optimizer(experiment.optimizer, experiment.steps)
    state = start_state(trainable, optimizer, experiment.seed)
    step = jax.jit(step_of(experiment, optimizer, NO_NUMBERS))
    losses = []
    for _ in range(steps):
        state, metrics = step(state, frozen, random_batch(experiment))
        losses.append(float(metrics["loss"]))
    return variables, state, frozen, losses


@pytest.mark.parametrize("fusion", ["prefix", "adapter"])
def test_lora_regime_changes_adapters_and_projection_and_nothing_else(fusion):
    experiment = small_experiment(regime="lora")
    prompt = VisualPromptConfig(width=32, layers=1, heads=2, ffn=32)
    experiment = dataclasses.replace(
        experiment, model=dataclasses.replace(experiment.model, fusion=fusion, visual_prompt=prompt)
    )
    before, state, frozen, losses = train(experiment, 6)
    after = join_variables(state.trainable, frozen)
    changed = {
        path[0].key if path[0].key == "lora" else path[1].key
        for (path, old), new in zip(jax.tree_util.tree_leaves_with_path(before), jax.tree.leaves(after), strict=True)
        if not np.array_equal(old, new)
    }
    assert changed == {"lora", "projector"}
    if fusion == "adapter":
        old, new = (tree["params"]["projector"] for tree in (before, after))
        assert all(not np.array_equal(a, b) for a, b in zip(jax.tree.leaves(old), jax.tree.leaves(new), strict=True))
    assert losses[-1] < losses[0]


@pytest.mark.parametrize("method", ["adamw", "muon"])
def test_full_regime_fits_a_batch(method):
    optimizer = OptimizerConfig(method=method)
    _, _, _, losses = train(dataclasses.replace(small_experiment(optimizer=optimizer), steps=60), 60)
    assert losses[-1] < 0.5 * losses[0]


def test_muon_turns_a_layers_update_and_leaves_its_size():
    """By the singular values of each matrix, stacked ones each by itself. What is no matrix is left to AdamW."""
    rng = np.random.default_rng(0)
    tree = {
        "layers": {"up": {"kernel": rng.normal(size=(2, 48, 32))}},
        "linear": {"kernel": rng.normal(size=(24, 40)), "bias": rng.normal(size=40)},
        "patch_kernel": rng.normal(size=(4, 4, 3, 8)),
    }
    weights, gradient = jax.tree.map(jnp.zeros_like, tree), jax.tree.map(jnp.asarray, tree)

    config = OptimizerConfig(method="muon", learning_rate=1e-2, warmup_steps=0, gradient_clip=math.inf)

    def update(optimizer: optax.GradientTransformation) -> dict[str, Any]:
        changes, _ = jax.jit(optimizer.update)(gradient, optimizer.init(weights), weights)
        return jax.tree.map(lambda leaf: np.asarray(leaf) / 1e-2, changes)

    muon = update(make_optimizer(config, 10))
    adamw = update(optax.adamw(1e-2, config.beta1, config.beta2, weight_decay=0.0, nesterov=True))
    for change, of in (
        *zip(muon["layers"]["up"]["kernel"], tree["layers"]["up"]["kernel"], strict=True),
        (muon["linear"]["kernel"], tree["linear"]["kernel"]),
    ):
        left, _, right = np.linalg.svd(of, full_matrices=False)
        turned = -(left.T @ change @ right.T)
        singular = np.diag(turned) / (0.2 * np.sqrt(max(of.shape)))
        assert np.all((singular > 0.6) & (singular < 1.3)), "all directions are equally large, up to Newton and Schulz"
        assert np.abs(turned - np.diag(np.diag(turned))).max() < 0.02
        assert 0.15 < np.sqrt(np.mean(change**2)) < 0.25
    np.testing.assert_allclose(muon["linear"]["bias"], adamw["linear"]["bias"], rtol=1e-6)
    np.testing.assert_allclose(muon["patch_kernel"], adamw["patch_kernel"], rtol=1e-6)


@pytest.mark.parametrize("steps", [1, 2])
def test_few_steps_have_a_schedule(steps):
    optimizer = make_optimizer(OptimizerConfig(), steps)
    weight = jnp.ones((2, 2))
    state = optimizer.init(weight)
    update = weight
    for _ in range(steps):
        update, state = optimizer.update(jnp.ones((2, 2)), state, weight)
    assert np.all(np.asarray(update) < 0)
    with pytest.raises(UserError, match="steps: expected at least 1, got 0"):
        dataclasses.replace(small_experiment(), steps=0)


def test_only_answer_tokens_are_learned():
    rng = np.random.default_rng(0)
    logits = jnp.asarray(rng.normal(size=(2, 6, 10)), jnp.float32)
    tokens = rng.integers(0, 10, (2, 6))
    answer = np.broadcast_to(np.arange(6) >= 4, (2, 6))
    batch = jax.tree.map(jnp.asarray, text_example(tokens, answer, np.zeros((2, 6), np.int32)))

    def loss(logits):
        return answer_loss(logits, batch, NO_NUMBERS)[0]

    gradient = np.abs(np.asarray(jax.grad(loss)(logits))).sum(-1)
    assert (gradient[:, 3:5] > 0).all(), "positions 3 and 4 predict the answer tokens 4 and 5"
    assert (gradient[:, [0, 1, 2, 5]] == 0).all()
    probabilities = np.exp(logits) / np.exp(logits).sum(-1, keepdims=True)
    expected = -np.mean([np.log(probabilities[b, t - 1, tokens[b, t]]) for b in range(2) for t in (4, 5)])
    np.testing.assert_allclose(loss(logits), expected, rtol=1e-5)


def number_example(tokenizer: Tokenizer, guess: list[list[int]], sigma: float = 0.0):
    """The loss's metrics where the answer is [[12, -7, 140, 0, 99, 0, 7, 1]] and each token is predicted as `guess`."""
    truth = np.array([[12, -7, 140, 0, 99, 0, 7, 1]])
    numbers = number_rows(tokenizer, "paper")
    prompt = format_prompt("lift", truth, None, "paper")
    text, answer = encode_text(tokenizer, prompt, format_answer(truth, "paper"), 400)
    rows = np.zeros(400, np.int32)
    rows[answer] = numbers.rows(truth)
    predicted = encode_text(tokenizer, prompt, format_answer(np.array(guess), "paper"), 400)[0].tokens
    logits = 50.0 * jax.nn.one_hot(np.roll(predicted, -1), tokenizer.vocab_size)[None]
    batch = jax.tree.map(jnp.asarray, text_example(text.tokens[None], answer[None], rows[None]))
    return {k: float(v) for k, v in answer_loss(logits, batch, numbers.targets(sigma))[1].items()}


@pytest.mark.parametrize("kind", KINDS)
def test_bins_within_one_are_counted_number_by_number(kind):
    tokenizer = small_tokenizer(kind)
    assert number_example(tokenizer, [[12, -7, 140, 0, 99, 0, 7, 1]])["bin_within_one"] == 1
    # One off in the last digit; the status is not a bin; of the 7 bins one is five off, and one of the wrong sign.
    assert number_example(tokenizer, [[13, -7, 141, 0, 98, 0, 7, 0]])["bin_within_one"] == 1
    np.testing.assert_allclose(number_example(tokenizer, [[17, -7, 140, 0, 99, 0, 7, 1]])["bin_within_one"], 6 / 7)
    np.testing.assert_allclose(number_example(tokenizer, [[12, 7, 145, 0, 99, 0, 7, 1]])["bin_within_one"], 5 / 7)


@pytest.mark.parametrize("kind", KINDS)
def test_soft_targets_are_the_probabilities_of_nearby_bins(kind):
    """Along a number's tokens, the distributions to learn multiply to the Gaussian over its slot's bins."""
    tokenizer, sigma = small_tokenizer(kind), 1.5
    numbers, grammar = number_rows(tokenizer, "paper"), build_answer_grammar(tokenizer, 1, "paper")
    targets, slot = numbers.targets(sigma), grammar.slots[0]
    assert targets.weights is not None
    truth = np.array([[139, 0, 0, 0, 0, 0, 100, 1]])
    first = len(grammar.templates[0])
    rows = numbers.rows(truth)[first : first + len(slot.tokens[139 + 100])]
    values = np.arange(-100, 201)
    gaussian = np.exp(-0.5 * ((values - 139) / sigma) ** 2)
    path = slot.tokens[139 + 100]
    for place, row in enumerate(rows):
        under = [tokens[:place] == path[:place] and len(tokens) > place for tokens in slot.tokens]
        offered = {tokens[place] for tokens, inside in zip(slot.tokens, under, strict=True) if inside}
        if len(offered) == 1:
            assert row == 0
            continue
        for token in offered:
            leads = [inside and t[place] == token for t, inside in zip(slot.tokens, under, strict=True)]
            expected = gaussian[leads].sum() / gaussian[under].sum()
            weight = targets.weights[row, list(targets.tokens).index(token)]
            np.testing.assert_allclose(weight, expected, rtol=1e-5, atol=1e-30)
        np.testing.assert_allclose(targets.weights[row].sum(), 1, rtol=1e-6)
    assert numbers.rows(truth)[-2:].tolist() == [0, 0], "neither status, full stop nor end"
    soft, hard = (number_example(tokenizer, [[12, -7, 140, 0, 99, 0, 7, 1]], s)["loss"] for s in (sigma, 0.0))
    assert hard < 1e-3 < soft


def test_experiment_survives_json(tmp_path: Path):
    experiment = small_experiment(regime="lora")
    save_experiment(tmp_path / "config.json", experiment)
    assert load_experiment(tmp_path / "config.json") == experiment
