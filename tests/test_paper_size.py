"""The paper's sizes by their shapes alone: nothing of 7 billion parameters is allocated."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from configs import get_config
from dsvla_jax.encoding.encode import example_spec
from dsvla_jax.encoding.number_targets import number_rows
from dsvla_jax.encoding.pretrained_tokenizers import load_tokenizer
from dsvla_jax.encoding.text import WordTokenizer
from dsvla_jax.errors import UserError
from dsvla_jax.model.variables import split_variables
from dsvla_jax.model.vla import initialize
from dsvla_jax.suite_vocabulary import tokenizer_of
from dsvla_jax.training.state import make_optimizer, start_state
from tests.learning import step_of
from tests.vocabularies import small_tokenizer

EXPERIMENT = get_config("paper_7b")


@pytest.fixture(scope="module")
def shapes() -> dict[str, Any]:
    return jax.eval_shape(lambda: initialize(EXPERIMENT.model, jax.random.key(0)))


def count(tree: Any) -> int:
    return sum(math.prod(leaf.shape) for leaf in jax.tree.leaves(tree))


def test_backbones_have_the_published_number_of_parameters(shapes):
    # LLaMA-7B: 6,738,415,616. CLIP's vision model without and with its projection: 303,507,456 and 304,293,888.
    params = shapes["params"]
    assert count(params["language"]) == 6_738_415_616
    assert count(params["vision"]) == 304_293_888
    assert params["vision"]["projection"].shape == (1024, 768)
    assert count(params["vision"]) - 1024 * 768 == 303_507_456


def test_what_learns_by_name(shapes):
    trainable, frozen = split_variables(shapes, EXPERIMENT.regime)
    counts = {f"lora/{tower}": count(tree) for tower, tree in trainable["lora"].items()}
    counts |= {name: count(tree) for name, tree in trainable["params"]["projector"].items()}
    assert counts == {
        "lora/language": 32 * 16 * (4 * (4096 + 4096) + 3 * (4096 + 11008)),  # 39.98 M
        "lora/vision": 24 * 16 * (4 * (1024 + 1024) + 2 * (1024 + 4096)),  # 7.08 M
        "clip_proj": 768 * 1024 + 1024,
        "clip_proj_norm": 2 * 1024,  # 0.79 M with the layer before
        "visual_blocks": 16 * (4 * 1024**2 + 3 * 1024 * 2816 + 2 * 1024),
        "visual_blocks_norm": 1024,
        "visual_blocks_output": 1024**2,  # 206.6 M with the two before
        "visual_proj": 1024 * 4096 + 4096,
        "visual_proj_norm": 2 * 4096,  # 4.21 M with the layer before
        "adapter_query": 32 * 577 * 4096,  # 75.6 M
        "gate": 32 * 32,
    }
    assert set(trainable["params"]) == {"projector"}
    assert set(frozen) == {"params"}
    assert set(frozen["params"]) == {"vision", "language"}
    assert count(trainable) == 334_283_776


def test_training_step_has_consistent_shapes(shapes):
    trainable, frozen = split_variables(shapes, EXPERIMENT.regime)
    optimizer = make_optimizer(EXPERIMENT.optimizer, EXPERIMENT.steps)
    targets = number_rows(small_tokenizer("sentencepiece"), EXPERIMENT.encoding.style).targets(0.0)
    step = step_of(EXPERIMENT, optimizer, targets)
    state = jax.eval_shape(lambda tree: start_state(tree, optimizer, EXPERIMENT.seed), trainable)
    size = EXPERIMENT.data.image_size
    batch = example_spec(EXPERIMENT.encoding, EXPERIMENT.batch_size, 1, size, size)
    after, metrics = jax.eval_shape(step, state, frozen, batch)
    assert jax.tree.map(lambda x: (x.shape, x.dtype), after) == jax.tree.map(lambda x: (x.shape, x.dtype), state)
    assert metrics["loss"].shape == ()


def test_the_papers_settings():
    encoding, optimizer = EXPERIMENT.encoding, EXPERIMENT.optimizer
    assert (encoding.image_size, encoding.points.num_points, encoding.points.num_tokens) == (336, 2048, 576)
    assert (encoding.points.width, encoding.points.neighbours) == (1024, 16)
    assert (encoding.style, encoding.alignment, encoding.max_text_length) == ("paper", "aligned", 512)
    assert EXPERIMENT.soft_target_sigma == 0
    np.testing.assert_allclose(optimizer.learning_rate, 1.17e-6, rtol=2e-3)
    # Neither warm-up nor clipping: the first update has the full rate, whatever the gradient's size.
    transform = make_optimizer(optimizer, EXPERIMENT.steps)
    weights = {"gate": jnp.zeros(3)}
    updates: Any = transform.update({"gate": jnp.full(3, 1e6)}, transform.init(weights), weights)[0]
    np.testing.assert_allclose(updates["gate"], -optimizer.learning_rate, rtol=1e-4)


def test_a_missing_or_foreign_vocabulary_is_named(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError, match=r"tokenizers/llama/tokenizer\.json is missing, .*--tokenizer"):
        tokenizer_of(EXPERIMENT.tokenizer, EXPERIMENT.model.language.vocab_size)
    folder = tmp_path / "tokenizers" / "llama"
    folder.mkdir(parents=True)
    tokenizer = WordTokenizer(("a", "b"))
    tokenizer.save(folder)
    assert load_tokenizer(folder) == tokenizer
    with pytest.raises(UserError, match=f"has {tokenizer.vocab_size} tokens, .* is 32000"):
        tokenizer_of(EXPERIMENT.tokenizer, EXPERIMENT.model.language.vocab_size)
