"""Both backbones against `transformers`: tests/golden/backbones.py wrote what it computes with the same weights."""

import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dsvla_jax.model.clip import VisionTower
from dsvla_jax.model.config import LanguageConfig, ModelConfig, RopeScaling, VisionConfig
from dsvla_jax.model.llama import KVCache, Llama, rotary_frequencies
from dsvla_jax.weights.readers.any_format import read_language, read_vision
from dsvla_jax.weights.towers import Tower
from tests.golden.backbones import CLIPS, LLAMAS, RESAMPLED_TO, draw, draw_image
from tests.safetensors_files import write_checkpoint

GOLDEN = Path(__file__).parent / "golden"
CASES = json.loads((GOLDEN / "backbones.json").read_text())
ARRAYS = np.load(GOLDEN / "backbones.npz")


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Checkpoint folders by case name, two of them as transformers wrote them."""
    root = tmp_path_factory.mktemp("backbones")
    for name, case in CASES.items():
        tensors = {key: draw(key, tuple(shape)) for key, shape in case["shapes"].items()}
        write_checkpoint(root / name, case["config"], tensors)
    return {name: root / name for name in CASES} | {name: GOLDEN / name for name in ("llama_sharded", "clip")}


def assert_close(ours, theirs):
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-4 * np.abs(theirs).max())


def run_llama(tower: Tower, tokens, positions, visible, attention: Any = "explicit"):
    """Hidden states and logits; visible: bool (B, T), the tokens that are not padding."""
    assert isinstance(tower.config, LanguageConfig)
    model = Llama(ModelConfig(language=tower.config, attention=attention))
    length = tokens.shape[1]
    mask = jnp.tril(jnp.ones((length, length), bool)) & visible[:, None, :]

    @jax.jit
    def run(params):
        bound = model.bind({"params": params})
        hidden, _ = bound(bound.embed(tokens), positions, mask)
        return hidden, bound.lm_head(hidden)

    return run(tower.load())


@pytest.mark.parametrize("name", [*LLAMAS, "llama_sharded"])
@pytest.mark.parametrize("attention", ["explicit", "fused"])
def test_llama_with_padding_on_either_side_is_that_of_transformers(folders, name, attention):
    tokens, positions, mask = (ARRAYS[f"{name}.{key}"] for key in ("tokens", "positions", "mask"))
    hidden, logits = run_llama(read_language(folders[name]), tokens, positions, mask, attention)
    assert_close(np.asarray(hidden)[mask], ARRAYS[f"{name}.hidden"][mask])
    assert_close(np.asarray(logits)[mask], ARRAYS[f"{name}.logits"][mask])


@pytest.mark.parametrize("name", ["head_dim", "llama3"])
def test_llama_token_by_token_is_that_of_transformers(folders, name):
    """Through the cache, whose shape and positions depend on the head width."""
    tower = read_language(folders[name])
    assert isinstance(tower.config, LanguageConfig)
    config = ModelConfig(language=tower.config)
    tokens, hidden = (ARRAYS[f"{name}.{key}"][:1] for key in ("tokens", "hidden"))
    length = tokens.shape[1]
    model = Llama(config)

    @jax.jit
    def step(params, cache, index):
        bound = model.bind({"params": params})
        token = bound.embed(jax.lax.dynamic_slice_in_dim(jnp.asarray(tokens), index, 1, axis=1))
        return bound(token, index[None, None], (jnp.arange(length) <= index)[None, None], cache, index)

    cache, outputs = KVCache.empty(config, 1, length), []
    for index in range(length):
        output, cache = step(tower.load(), cache, jnp.asarray(index))
        outputs.append(output)
    assert_close(np.concatenate(outputs, axis=1), hidden)


def test_the_scaled_case_meets_all_three_bands(folders):
    config = read_language(folders["llama3"]).config
    assert isinstance(config, LanguageConfig)
    assert config.rope_scaling == RopeScaling(8.0, 1.0, 4.0, 40)
    plain = rotary_frequencies(LanguageConfig(width=32, heads=2, kv_heads=1))
    ratio = plain / rotary_frequencies(config)
    assert (ratio == 1).any()
    assert (ratio == 8).any()
    assert ((ratio > 1.01) & (ratio < 7.9)).any()


def run_clip(tower: Tower, size: int):
    assert isinstance(tower.config, VisionConfig)
    model = VisionTower(ModelConfig(vision=tower.config))
    width = tower.config.width
    no_points = jnp.zeros((2, 0, width)), jnp.zeros((2, 0), jnp.int32)
    return jax.jit(model.apply)({"params": tower.load()}, draw_image(size)[:, None], *no_points)


@pytest.mark.parametrize("name", [*CLIPS, "clip"])
def test_clip_without_3d_tokens_is_that_of_transformers(folders, name):
    tower = read_vision(folders[name])
    assert isinstance(tower.config, VisionConfig)
    size = tower.config.image_size
    assert_close(run_clip(tower, size), ARRAYS[f"{name}.output_{size}"])


def test_clip_with_its_projection_is_that_of_transformers():
    tower = read_vision(GOLDEN / "clip", projection=True)
    assert not [key for key in tower.unused if "text" not in key and key != "logit_scale"]
    assert_close(run_clip(tower, 9), ARRAYS["clip.projected_9"])


@pytest.mark.parametrize(("name", "size"), [(name, size) for name, sizes in RESAMPLED_TO.items() for size in sizes])
def test_clip_at_another_image_size_is_that_of_transformers(folders, name, size):
    assert_close(run_clip(read_vision(folders[name], size), size), ARRAYS[f"{name}.output_{size}"])


@pytest.mark.parametrize("name", [*CASES, "llama_sharded", "clip"])
def test_every_parameter_is_read_once(folders, name):
    """Each array holds exactly the values of its tensors, which all differ."""
    vision = name in CLIPS or name == "clip"
    tower = (read_vision if vision else read_language)(folders[name])
    if name in CASES:
        shapes = CASES[name]["shapes"]
        stored = np.concatenate([draw(key, tuple(shape)).ravel() for key, shape in shapes.items()])
        read = np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(tower.load())])
        np.testing.assert_array_equal(np.sort(read), np.sort(stored))
    assert not [key for key in tower.unused if key.startswith(("model.", "vision_model."))]
