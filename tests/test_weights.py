"""Reading Hugging Face folders: names, dtypes, damage; and the imported folder that training starts from."""

import json
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dsvla_jax.checkpoints.storage import CheckpointError
from dsvla_jax.model.config import LanguageConfig, ModelConfig, RopeScaling, VisionConfig
from dsvla_jax.model.vla import VLA, initialize
from dsvla_jax.types import ModelInputs, Text
from dsvla_jax.weights import __main__ as program
from dsvla_jax.weights.backbones import import_backbones, load_backbones, read_towers
from dsvla_jax.weights.imported_folder import create_weights
from dsvla_jax.weights.positions import resample_positions
from dsvla_jax.weights.readers.any_format import read_language, read_vision
from dsvla_jax.weights.readers.safetensors import list_tensors
from dsvla_jax.weights.stored_tensors import WeightsError
from dsvla_jax.weights.towers import summarize
from tests.golden.backbones import draw
from tests.safetensors_files import write_checkpoint

GOLDEN = Path(__file__).parent / "golden"
CASES = json.loads((GOLDEN / "backbones.json").read_text())
SHARD = "model-00002-of-00003.safetensors"


@pytest.fixture
def sharded(tmp_path):
    """A copy of transformers' own sharded checkpoint, to be damaged."""
    return Path(shutil.copytree(GOLDEN / "llama_sharded", tmp_path / "source"))


def case_tensors(name):
    return {key: draw(key, tuple(shape)) for key, shape in CASES[name]["shapes"].items()}


def assert_same(left, right):
    jax.tree.map(np.testing.assert_array_equal, left, right)


def change_json(file, **changes):
    file.write_text(json.dumps(json.loads(file.read_text()) | changes))


@pytest.mark.parametrize("prefix", ["", "model.", "language_model.model."])
def test_llama_behind_any_prefix(tmp_path, prefix):
    tensors = case_tensors("plain")
    head = tensors.pop("lm_head.weight")
    renamed = {prefix + key.removeprefix("model."): value for key, value in tensors.items()}
    renamed[prefix.removesuffix("model.") + "lm_head.weight"] = head
    params = read_language(write_checkpoint(tmp_path / "source", CASES["plain"]["config"], renamed)).load()
    np.testing.assert_array_equal(params["output"], head.T)
    np.testing.assert_array_equal(
        params["layers"]["down"]["kernel"][1], tensors["model.layers.1.mlp.down_proj.weight"].T
    )


@pytest.mark.parametrize("prefix", ["", "vision_model.", "vision_tower.vision_model."])
def test_clip_behind_any_prefix_and_within_other_configs(tmp_path, prefix):
    tensors = {prefix + key: value for key, value in case_tensors("odd_grid").items()}
    config = CASES["odd_grid"]["config"]
    if prefix:
        config = {"model_type": "llava", "vision_config": config}
        tensors["elsewhere.weight"] = np.zeros(3, np.int64)
    tower = read_vision(write_checkpoint(tmp_path / "source", config, tensors))
    assert tower.unused == (("elsewhere.weight",) if prefix else ())
    kernel = tensors[prefix + "embeddings.patch_embedding.weight"]
    np.testing.assert_array_equal(tower.load()["patch_kernel"][1, 2, 0], kernel[:, 0, 1, 2])


@pytest.mark.parametrize("dtype", [np.float32, np.float16, jnp.bfloat16])
def test_every_dtype_is_read_exactly(tmp_path, dtype):
    tensors = {key: value.astype(dtype) for key, value in case_tensors("grouped_tied").items()}
    tower = read_language(write_checkpoint(tmp_path / "source", CASES["grouped_tied"]["config"], tensors))
    table = tower.load()["embedding"]
    assert table.dtype == np.float32
    np.testing.assert_array_equal(table, tensors["model.embed_tokens.weight"].astype(np.float32))


def test_old_configs_mean_the_same(tmp_path):
    """Before transformers 5: rope_theta and rope_scaling, no head_dim; Llama 1 had no num_key_value_heads."""
    new = CASES["llama3"]["config"]
    rope = dict(new["rope_parameters"])
    old = {key: value for key, value in new.items() if key not in ("rope_parameters", "head_dim")}
    old |= {"rope_theta": rope.pop("rope_theta"), "rope_scaling": rope}
    folder = write_checkpoint(tmp_path / "llama3", old, case_tensors("llama3"))
    config = read_language(folder).config
    assert isinstance(config, LanguageConfig)
    assert config.rope_scaling == RopeScaling(8.0, 1.0, 4.0, 40)
    assert (config.rope_theta, config.kv_heads, config.head_dim) == (10000.0, 1, 16)

    new = CASES["plain"]["config"]
    old = {
        key: value for key, value in new.items() if key not in ("rope_parameters", "head_dim", "num_key_value_heads")
    }
    config = read_language(write_checkpoint(tmp_path / "plain", old, case_tensors("plain"))).config
    assert isinstance(config, LanguageConfig)
    assert config.kv_heads == 4


def test_left_out_fields_have_the_defaults_of_the_architecture(tmp_path):
    folder = tmp_path / "source"
    folder.mkdir()
    (folder / "config.json").write_text('{"model_type": "llama", "vocab_size": 32000}')
    with pytest.raises(WeightsError, match="holds neither model"):
        read_language(folder)  # the config is LLaMA-7B's, and only then are files looked for


EMBEDDING, HEAD = "model.embed_tokens.weight", "lm_head.weight"


def read_tied(tmp_path, tensors):
    """A checkpoint whose config.json says tie_word_embeddings."""
    return read_language(write_checkpoint(tmp_path / "source", CASES["grouped_tied"]["config"], tensors))


def test_the_copy_of_a_tied_table_is_kept_once(tmp_path):
    tensors = case_tensors("grouped_tied")
    tower = read_tied(tmp_path, tensors | {HEAD: tensors[EMBEDDING]})
    assert isinstance(tower.config, LanguageConfig)
    assert tower.config.tie_embeddings
    assert tower.unused == (HEAD,)
    assert tower.notes == (f"{HEAD} equals {EMBEDDING}: tied, and kept once",)


@pytest.mark.parametrize("row", [0, -1])
def test_a_head_of_its_own_is_used_whatever_the_config_says(tmp_path, row):
    """As transformers 5 does it, which says so in a warning."""
    tensors = case_tensors("grouped_tied")
    head = tensors[EMBEDDING].copy()
    head[row, 0] += 0.001
    tower = read_tied(tmp_path, tensors | {HEAD: head})
    assert isinstance(tower.config, LanguageConfig)
    assert not tower.config.tie_embeddings
    np.testing.assert_array_equal(tower.load()["output"], head.T)
    assert "differs from model.embed_tokens.weight" in tower.notes[0]
    assert not tower.unused


def test_a_tied_table_may_be_stored_as_the_head_alone(tmp_path):
    tensors = case_tensors("grouped_tied")
    table = tensors.pop(EMBEDDING)
    tower = read_tied(tmp_path, tensors | {HEAD: table})
    assert isinstance(tower.config, LanguageConfig)
    assert tower.config.tie_embeddings
    np.testing.assert_array_equal(tower.load()["embedding"], table)


def test_a_head_far_outside_of_its_decoder_is_found(tmp_path):
    """Where multimodal models of transformers 5 have it."""
    tensors = case_tensors("plain")
    renamed = {key.replace("model.", "model.language_model."): value for key, value in tensors.items()}
    params = read_language(write_checkpoint(tmp_path / "source", CASES["plain"]["config"], renamed)).load()
    np.testing.assert_array_equal(params["output"], tensors[HEAD].T)


@pytest.mark.parametrize(
    ("extra", "message"),
    [
        ({"other.lm_head.weight": np.zeros((53, 42), np.float32)}, "other.lm_head.weight: of another model than the"),
        ({"lm_head.bias": np.zeros(53, np.float32)}, "no place in this architecture for: lm_head.bias"),
        ({HEAD: np.zeros((54, 42), np.float32)}, r"lm_head.weight: expected shape \(53, 42\) by its sizes, found"),
    ],
)
def test_heads_that_do_not_fit_are_refused_of_tied_models_too(tmp_path, extra, message):
    with pytest.raises(WeightsError, match=message):
        read_tied(tmp_path, case_tensors("grouped_tied") | extra)


@pytest.mark.parametrize("dtype", [np.float32, np.float16, jnp.bfloat16])
def test_saved_constants_are_compared_before_they_are_left_alone(tmp_path, dtype):
    key = "model.layers.0.self_attn.rotary_emb.inv_freq"
    frequencies = 10000.0 ** -(np.arange(3) / 3)
    for name, values, notes in (("same", frequencies, 0), ("other", 2 * frequencies, 1)):
        tower = read_tied(tmp_path / name, case_tensors("grouped_tied") | {key: values.astype(dtype)})
        assert tower.unused == (key,)
        assert len(tower.notes) == notes
    assert key in tower.notes[0]
    key, positions = "embeddings.position_ids", np.arange(10)[None]
    for name, values, notes in (("same", positions, 0), ("other", positions[:, ::-1].copy(), 1)):
        tensors = case_tensors("odd_grid") | {key: values}
        tower = read_vision(write_checkpoint(tmp_path / name / "clip", CASES["odd_grid"]["config"], tensors))
        assert tower.unused == (key,)
        assert len(tower.notes) == notes


def test_missing_and_surplus_tensors_are_all_named(tmp_path):
    tensors = case_tensors("plain")
    del tensors["model.norm.weight"], tensors["model.layers.0.mlp.up_proj.weight"]
    for layer in (0, 1):
        tensors[f"model.layers.{layer}.self_attn.q_proj.bias"] = np.zeros(32, np.float32)
    folder = write_checkpoint(tmp_path / "source", CASES["plain"]["config"], tensors)
    with pytest.raises(WeightsError) as error:
        read_language(folder)
    assert "missing: model.layers.0.mlp.up_proj.weight, model.norm.weight;" in str(error.value)
    assert "no place in this architecture for: model.layers.*.self_attn.q_proj.bias (2)" in str(error.value)


def test_summaries_tell_layers_once():
    assert summarize(["b.10.w", "b.9.w", "c.3.w", "a"]) == "a, b.*.w (2), c.3.w"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"model_type": "qwen2"}, r"config.json: wrong architecture: expected model_type 'llama' .* found 'qwen2'"),
        ({"attention_bias": True}, r"missing: .*k_proj.bias \(2\), .*o_proj.bias \(2\), "),
        ({"hidden_act": "gelu"}, "config.json: hidden_act: only 'silu' is supported, found 'gelu'"),
        ({"rope_parameters": {"rope_type": "yarn"}}, "config.json: rope_type: supported are .* found 'yarn'"),
        (
            {"rope_parameters": {"rope_type": "llama3", "factor": 8}},
            "'llama3' needs low_freq_factor, high_freq_factor,",
        ),
        ({"hidden_size": "16"}, "config.json: hidden_size: expected a number, found '16'"),
        ({"num_hidden_layers": 0}, "config.json: num_hidden_layers: expected a positive integer, found 0"),
        ({"num_hidden_layers": 10**9}, "21 tensors cannot be the 1000000000 layers that its config says"),
        ({"rms_norm_eps": float("nan")}, "rms_norm_eps: expected a number, found nan"),
        ({"rms_norm_eps": -1e-5}, "rms_norm_eps: expected a positive number, found -1e-05"),
        ({"rope_parameters": {"rope_theta": 0}}, "rope_theta: expected a positive number, found 0"),
        ({"rope_parameters": {"type": "linear", "factor": 2.0}}, "rope_type: supported are .* found 'linear'"),
        ({"rope_parameters": {"full_attention": {"rope_theta": 5.0}}}, "rope_type 'default': .* found full_attention"),
        ({"rope_parameters": {"partial_rotary_factor": 0.5}}, "partial_rotary_factor: only 1.0 is supported"),
        ({"rope_scaling": {"type": "default", "rope_theta": 5.0}}, "rope_scaling and rope_parameters differ"),
        ({"partial_rotary_factor": 0.5}, "partial_rotary_factor: only 1.0 is supported, found 0.5"),
        ({"tie_word_embeddings": "false"}, "tie_word_embeddings: expected true or false, found 'false'"),
        ({"attention_bias": "false"}, "attention_bias: expected true or false"),
        ({"mlp_bias": True}, r"missing: .*down_proj.bias \(2\), .*gate_proj.bias \(2\), "),
        ({"sliding_window": 4096}, "sliding_window: only 0 is supported, found 4096"),
        ({"layer_types": ["full_attention", "sliding_attention"]}, "layer_types: .* found 'sliding_attention'"),
        ({"final_logit_softcapping": 30.0}, "final_logit_softcapping: only 0 is supported, found 30.0"),
        ({"attention_multiplier": 0.0156}, "attention_multiplier: only 1.0 is supported"),
        ({"quantization_config": {"bits": 4}}, "quantization_config: only {} is supported"),
        ({"auto_map": {"AutoModelForCausalLM": "own.Own"}}, "auto_map: AutoModelForCausalLM: .* code of its own"),
        ({"num_key_value_heads": 3}, "config.json: model.language.kv_heads: expected a divisor of heads 2, got 3"),
        ({"vocab_size": 22}, r"00001-of-.*: model.embed_tokens.weight: expected shape \(22, 16\) .* found \(21, 16\)"),
        ({"num_hidden_layers": 1}, r"no place in this architecture for: model.layers.1.input_layernorm.weight, "),
        ({"num_hidden_layers": 3}, r"missing: model.layers.2.input_layernorm.weight, "),
    ],
)
def test_another_architecture_is_refused(sharded, changes, message):
    change_json(sharded / "config.json", **changes)
    with pytest.raises(WeightsError, match=message):
        read_language(sharded)


def test_fields_that_change_nothing_are_no_hindrance(sharded):
    fields = {"sliding_window": 9, "use_sliding_window": False, "partial_rotary_factor": None, "rope_scaling": None}
    change_json(sharded / "config.json", **fields, layer_types=["full_attention"] * 2, auto_map={"AutoTokenizer": "x"})
    assert read_language(sharded).config == read_language(GOLDEN / "llama_sharded").config


CLIP_NUMBERS = {"image_mean": [0.48145466, 0.4578275, 0.40821073], "image_std": [0.26862954, 0.26130258, 0.27577711]}


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("preprocessor_config.json", CLIP_NUMBERS | {"rescale_factor": 0.00392156862745098}, None),
        ("preprocessor_config.json", CLIP_NUMBERS | {"image_mean": [0.5, 0.5, 0.5]}, "image_mean: only CLIP's 0.4815"),
        ("preprocessor_config.json", {"image_std": 0.5}, "image_std: only CLIP's 0.2686, 0.2613, 0.2758 is supported"),
        ("preprocessor_config.json", {"do_normalize": False}, "do_normalize: only True is supported"),
        ("processor_config.json", {"image_processor": {"rescale_factor": 1.0}}, "rescale_factor: only CLIP's 0.00392"),
        ("config.json", {"vision_config_dict": {"hidden_act": "gelu"}}, "hidden_act: only 'gelu' .* 'quick_gelu'"),
        ("config.json", {"vision_config_dict": {"hidden_act": "quick_gelu", "num_hidden_layers": None}}, None),
    ],
)
def test_a_tower_for_other_pictures_is_refused(tmp_path, file, content, message):
    folder = Path(shutil.copytree(GOLDEN / "clip", tmp_path / "source"))
    known = json.loads((folder / file).read_text()) if (folder / file).exists() else {}
    (folder / file).write_text(json.dumps(known | content))
    if message is None:
        assert read_vision(folder).config == read_vision(GOLDEN / "clip").config
        return
    with pytest.raises(WeightsError, match=message):
        read_vision(folder)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"image_size": 0}, "image size: expected 1 to 4096 pixels, got 0"),
        ({"image_size": -9}, "image size: expected 1 to 4096 pixels, got -9"),
        ({"image_size": 300_000}, "image size: expected 1 to 4096 pixels"),
        ({"adapter": GOLDEN / "original" / "adapter.pth", "adapter_heads": 0}, "heads .* expected at least 1, got 0"),
        ({"adapter_heads": 3}, "heads .* need an adapter"),
    ],
)
def test_options_out_of_range_are_refused_before_anything_is_written(tmp_path, options, message):
    with pytest.raises(WeightsError, match=message):
        import_backbones(GOLDEN / "llama_sharded", tmp_path / "out", GOLDEN / "clip", **options)
    assert not list(tmp_path.iterdir())


def cut(file, keep):
    file.write_bytes(file.read_bytes()[:keep])


def no_index(folder):
    (folder / "model.safetensors.index.json").unlink()


def only_pickles(folder):
    for file in folder.glob("model*"):
        file.unlink()
    (folder / "pytorch_model.bin").touch()


def eight_bit(folder):
    file = folder / SHARD
    file.write_bytes(file.read_bytes().replace(b'"dtype":"BF16"', b'"dtype":"F8E4"'))


def half_as_wide(folder):
    file = folder / SHARD
    file.write_bytes(file.read_bytes().replace(b'"dtype":"BF16"', b'"dtype":"F32" '))


def other_map(folder):
    file = folder / "model.safetensors.index.json"
    change_json(file, weight_map=json.loads(file.read_text())["weight_map"] | {"model.extra": SHARD})


def two_models(folder):
    shutil.copy(folder / SHARD, folder / "model.safetensors")


def twice(folder):
    shutil.copy(folder / SHARD, folder / "model-00004-of-00003.safetensors")
    file = folder / "model.safetensors.index.json"
    change_json(file, weight_map=json.loads(file.read_text())["weight_map"] | {"x": "model-00004-of-00003.safetensors"})


def outside(folder):
    file = folder / "model.safetensors.index.json"
    change_json(file, weight_map={"model.embed_tokens.weight": f"../source/{SHARD}"})


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda f: cut(f / SHARD, -1), r"00002-of-00003.safetensors: model\.\S+: ends at byte 4832, the file has 4831"),
        (lambda f: cut(f / SHARD, 100), "00002-of-00003.safetensors: 100 bytes, but its header alone should have"),
        (lambda f: cut(f / SHARD, 0), "00002-of-00003.safetensors: 0 bytes, but its header"),
        (lambda f: (f / SHARD).write_bytes(b"\x04" + bytes(7) + b"[{}]"), "header is not that of a safetensors file"),
        (lambda f: (f / SHARD).unlink(), "00002-of-00003.safetensors: this shard is missing, .*index.json names it"),
        (outside, "00002-of-00003.safetensors: this shard is missing"),
        (other_map, "00002-of-00003.safetensors: model.extra is not in it, though .*index.json says so"),
        (two_models, "source: holds two models, model.safetensors and model.safetensors.index.json"),
        (twice, rf"00004-of-00003.safetensors: model\.\S+ is in {SHARD} already"),
        (no_index, r"index.json: missing, so it is unknown whether model-00001-\S+, \S+, \S+ is all"),
        (only_pickles, "source: holds neither model.safetensors nor .* save_pretrained"),
        (eight_bit, r"00002-of-00003.safetensors: model\.\S+: expected dtype F32, F16, BF16, found F8E4"),
        (half_as_wide, r"00002-of-00003.safetensors: model\.\S+: F32 \(.*\) does not fill the \d+ bytes"),
        (lambda f: cut(f / "config.json", 20), "config.json: not JSON"),
        (lambda f: (f / "config.json").unlink(), "config.json: missing; expected the folder of a Hugging Face"),
    ],
)
def test_damage_is_told_with_file_and_key(sharded, damage, message):
    damage(sharded)
    out = sharded.parent / "out"
    with pytest.raises(WeightsError, match=message):
        import_backbones(sharded, out)
    assert not out.exists()


@pytest.mark.parametrize("offered", ["adapter", "adapter/adapter_model.safetensors", "model"])
@pytest.mark.parametrize("option", ["source", "vision_source", "adapter"])
def test_an_adapter_of_peft_is_called_one(tmp_path, sharded, offered, option):
    """By itself, as any of the sources; and beside a model, which transformers would add it to."""
    tensors = {"base_model.model.model.layers.0.self_attn.q_proj.lora_A.weight": np.zeros((2, 16), np.float32)}
    folder = write_checkpoint(tmp_path / "adapter", {}, tensors)
    (folder / "config.json").unlink()
    (folder / "model.safetensors").rename(folder / "adapter_model.safetensors")
    config = {"peft_type": "LORA", "base_model_name_or_path": "meta-llama/Llama-2-7b-hf"}
    (folder / "adapter_config.json").write_text(json.dumps(config))
    shutil.copytree(folder, shutil.copytree(sharded, tmp_path / "model"), dirs_exist_ok=True)
    sources = {"source": sharded, "vision_source": GOLDEN / "clip", option: tmp_path / offered}
    with pytest.raises(WeightsError, match=r"an adapter of PEFT .*'meta-llama/Llama-2-7b-hf'.*merge_and_unload"):
        import_backbones(out=tmp_path / "out", **sources)
    assert not (tmp_path / "out").exists()


def test_files_where_folders_are_expected_say_so(tmp_path):
    with pytest.raises(WeightsError, match=r"model.safetensors: a safetensors file, no PyTorch checkpoint; name its"):
        read_vision(GOLDEN / "clip" / "model.safetensors")
    with pytest.raises(WeightsError, match=r"model.safetensors: a file; expected the folder of a Hugging Face"):
        read_language(GOLDEN / "clip" / "model.safetensors")


def test_a_file_cut_anywhere_is_an_error(sharded):
    content = (sharded / SHARD).read_bytes()
    for keep in range(0, len(content), 97):
        (sharded / SHARD).write_bytes(content[:keep])
        with pytest.raises(WeightsError, match=SHARD):
            list_tensors(sharded)


def test_vision_sources_that_do_not_fit(tmp_path):
    with pytest.raises(WeightsError, match=r"expected model_type 'clip_vision_model' .* found 'llama'"):
        read_vision(GOLDEN / "llama_sharded")
    with pytest.raises(WeightsError, match=r"image size 10 .*image_size: expected a multiple of patch_size 3, got 10"):
        read_vision(GOLDEN / "clip", 10)
    folder = write_checkpoint(tmp_path / "source", CASES["odd_grid"]["config"], case_tensors("plain"))
    with pytest.raises(WeightsError, match=r"visual_projection.weight is missing"):
        read_vision(
            write_checkpoint(tmp_path / "tower", CASES["odd_grid"]["config"], case_tensors("odd_grid")), projection=True
        )
    with pytest.raises(WeightsError, match=r"wrong architecture: .*embeddings.class_embedding, none does"):
        read_vision(folder)
    config = CASES["odd_grid"]["config"] | {"hidden_act": "gelu"}
    with pytest.raises(WeightsError, match="hidden_act: only 'quick_gelu' is supported"):
        read_vision(write_checkpoint(tmp_path / "gelu", config, case_tensors("odd_grid")))


def test_resampled_positions_keep_constants_and_the_class_token():
    positions = np.ones((10, 4), np.float32)
    positions[0] = 7
    for grid in (1, 2, 5):
        resampled = resample_positions(positions, grid)
        np.testing.assert_array_equal(resampled[0], 7)
        np.testing.assert_allclose(resampled[1:], np.ones((grid * grid, 4)), atol=1e-6)
    with pytest.raises(ValueError, match="square"):
        resample_positions(positions[:7], 2)


@pytest.fixture(scope="module")
def imported(tmp_path_factory):
    out = tmp_path_factory.mktemp("imported") / "new" / "base"
    return out, import_backbones(GOLDEN / "llama_sharded", out, GOLDEN / "clip", 15, projection=True)


def test_imported_folder_gives_back_configs_and_params(imported):
    out, towers = imported
    stored = read_towers(out)
    assert stored.language == towers["language"].config
    assert stored.vision == towers["vision"].config
    assert isinstance(stored.vision, VisionConfig)
    assert stored.vision.image_size == 15
    assert_same(load_backbones(out), {"params": {name: tower.load() for name, tower in towers.items()}})


def test_a_model_runs_from_an_imported_folder(imported):
    out, _ = imported
    towers = read_towers(out)
    assert towers.vision is not None
    config = ModelConfig(vision=towers.vision, language=towers.language)
    variables = initialize(config, jax.random.key(0))
    backbones = load_backbones(out)["params"]
    assert jax.tree.map(jnp.shape, backbones) == jax.tree.map(
        jnp.shape, {name: variables["params"][name] for name in backbones}
    )
    inputs = ModelInputs(
        images=jnp.zeros((1, 1, 15, 15, 3)),
        point_tokens=jnp.zeros((1, 2, 16)),
        point_patches=jnp.zeros((1, 2), jnp.int32),
        text=Text(jnp.ones((1, 4), jnp.int32), jnp.ones((1, 4), bool)),
    )
    logits = VLA(config).apply({"params": variables["params"] | backbones}, inputs)
    assert np.isfinite(np.asarray(logits)).all()


def test_bfloat16_on_disk_is_float32_in_the_model(tmp_path):
    """The source is bfloat16 already, so that nothing is lost."""
    import_backbones(GOLDEN / "llama_sharded", tmp_path / "half", dtype=jnp.bfloat16)
    params = load_backbones(tmp_path / "half")["params"]
    assert {leaf.dtype for leaf in jax.tree.leaves(params)} == {jnp.dtype(jnp.float32)}
    assert_same(params["language"], read_language(GOLDEN / "llama_sharded").load())
    assert read_towers(tmp_path / "half").vision is None


def test_a_failed_write_leaves_no_folder(tmp_path):
    def write():
        leaves = {"a": jax.ShapeDtypeStruct((3,), np.float32)}
        with create_weights(tmp_path / "out", leaves, cast(Any, {"not JSON": object()})) as arrays:
            arrays["a"][...] = np.ones(3, np.float32)

    with pytest.raises(TypeError):
        write()
    assert not list(tmp_path.iterdir())


KILLED = """
import os, signal
from pathlib import Path
from dsvla_jax.weights import backbones, towers

def copy_to(self, array, dtype):
    if self.place[0].startswith("layers/down"):
        os.kill(os.getpid(), signal.SIGKILL)
    copy(self, array, dtype)

copy, towers.Piece.copy_to = towers.Piece.copy_to, copy_to
backbones.import_backbones(Path({source!r}), Path({out!r}))
"""


def test_a_killed_import_looks_like_none_and_is_no_hindrance(tmp_path):
    out = tmp_path / "out"
    code = KILLED.format(source=str(GOLDEN / "llama_sharded"), out=str(out))
    assert subprocess.run([sys.executable, "-c", code], cwd=GOLDEN.parents[1]).returncode == -signal.SIGKILL
    (left,) = tmp_path.iterdir()
    assert left != out
    with pytest.raises(CheckpointError, match="no imported weights here"):
        load_backbones(left)
    import_backbones(GOLDEN / "llama_sharded", out)
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
    load_backbones(out)


def test_an_existing_folder_is_not_touched(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(CheckpointError, match="exists already"):
        import_backbones(GOLDEN / "llama_sharded", tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


SHARDED = """
import json, sys
import jax
import numpy as np
import orbax.checkpoint as ocp
from pathlib import Path
from jax.sharding import AxisType, NamedSharding, PartitionSpec
from dsvla_jax.weights.backbones import backbone_shapes, load_backbones

jax.config.update("jax_num_cpu_devices", 4)
mesh = jax.make_mesh((2, 2), ("fsdp", "tensor"), axis_types=(AxisType.Auto,) * 2)

def sharded(leaf):
    matrix = leaf.ndim > 1 and not any(size % 2 for size in leaf.shape[-2:])
    spec = PartitionSpec(*[None] * (leaf.ndim - 2), "fsdp", "tensor") if matrix else PartitionSpec()
    return jax.ShapeDtypeStruct(leaf.shape, jax.numpy.bfloat16, sharding=NamedSharding(mesh, spec))

folder = Path(sys.argv[1])
like = jax.tree.map(sharded, backbone_shapes(folder))
params, whole = load_backbones(folder, like), load_backbones(folder)
with ocp.StandardCheckpointer() as checkpointer:
    by_orbax = checkpointer.restore(folder.absolute() / "params", like)

def check(asked, given, other, expected):
    assert given.dtype == jax.numpy.bfloat16 and given.sharding == asked.sharding, (given.sharding, asked.sharding)
    assert len(given.addressable_shards) == 4
    expected = np.asarray(expected.astype(jax.numpy.bfloat16))
    for mine, theirs in zip(given.addressable_shards, other.addressable_shards, strict=True):
        assert mine.data.shape == asked.sharding.shard_shape(asked.shape)
        np.testing.assert_array_equal(np.asarray(mine.data), expected[mine.index])
        np.testing.assert_array_equal(np.asarray(mine.data), np.asarray(theirs.data))
    return given.addressable_shards[0].data.nbytes / given.nbytes

print(json.dumps(jax.tree.map(check, like, params, by_orbax, whole)))
"""


def test_each_device_is_given_its_shard(imported):
    """And orbax alone, without this project, restores the folder too."""
    out, _ = imported
    command = [sys.executable, "-c", SHARDED, str(out)]
    finished = subprocess.run(command, cwd=GOLDEN.parents[1], capture_output=True, text=True)
    assert finished.returncode == 0, finished.stderr
    shares = json.loads(finished.stdout)["params"]
    assert shares["language"]["layers"]["gate"]["kernel"] == 0.25
    assert shares["vision"]["layers"]["o"]["kernel"] == 0.25
    assert shares["language"]["norm"]["scale"] == 1


def test_folders_that_are_no_imports_say_so(tmp_path):
    with pytest.raises(CheckpointError, match=r"no imported weights here; .* python -m dsvla_jax.weights import"):
        load_backbones(tmp_path)


def test_command_line(tmp_path, monkeypatch, capsys):
    out = tmp_path / "base"
    arguments = ["import", str(GOLDEN / "llama_sharded"), str(out), "--vision", str(GOLDEN / "clip")]
    monkeypatch.setattr(sys, "argv", ["weights", *arguments])
    program.main()
    printed = capsys.readouterr().out
    assert "language: 4,592 parameters" in printed
    assert "vision: left alone: logit_scale, " in printed
    assert read_towers(out).vision is not None
    with pytest.raises(SystemExit):
        program.main()
    assert "error: " in capsys.readouterr().err
