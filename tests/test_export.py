"""Weights out: what a folder of PEFT or transformers must hold. tests/test_parity.py opens such folders with both."""

import dataclasses
import json
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from safetensors.numpy import load_file
from tokenizers import Tokenizer

import dsvla_jax.weights.__main__ as program
from dsvla_jax.checkpoints.storage import CheckpointError
from dsvla_jax.errors import UserError
from dsvla_jax.model.config import (
    LanguageConfig,
    LoraConfig,
    ModelConfig,
    RopeScaling,
    VisionConfig,
    VisualPromptConfig,
)
from dsvla_jax.model.lora import merge_lora, unmerge_lora
from dsvla_jax.weights.export import ExportOptions, export_run
from dsvla_jax.weights.readers.any_format import read_language, read_vision
from tests.run_folders import TOKENIZER, write_run

LORA = LoraConfig(rank=3, alpha=7.0)
CONFIG = ModelConfig(
    vision=VisionConfig(image_size=24, patch_size=8, width=24, layers=2, heads=3, mlp_ratio=1.5),
    language=LanguageConfig(vocab_size=TOKENIZER.vocab_size, width=20, layers=3, heads=2, kv_heads=1, ffn=28),
    lora=LORA,
)
SCALED = dataclasses.replace(
    CONFIG.language, tie_embeddings=True, explicit_head_dim=12, rope_theta=500.0, rope_scaling=RopeScaling(4.0)
)
PROMPTED = dataclasses.replace(
    CONFIG,
    vision=dataclasses.replace(CONFIG.vision, embed_width=16),
    language=SCALED,
    fusion="adapter",
    visual_prompt=VisualPromptConfig(width=16, layers=1, heads=2, ffn=20),
    lora=dataclasses.replace(LORA, targets=("q", "up"), towers=("language",)),
)


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> tuple[Path, dict[str, Any]]:
    folder = tmp_path_factory.mktemp("runs") / "run"
    return folder, write_run(folder, CONFIG)


def export(run: Path, out: Path, model: ModelConfig = CONFIG, **options: Any) -> list[str]:
    return export_run(run, out, model, TOKENIZER, ExportOptions(**options))


def assert_same(ours: Any, theirs: Any) -> None:
    jax.tree.map(np.testing.assert_array_equal, ours, theirs)


@pytest.mark.parametrize("model", [CONFIG, PROMPTED], ids=["untied", "tied_scaled_projected"])
def test_merged_folders_are_read_back_as_the_merged_towers(tmp_path, model):
    variables = write_run(tmp_path / "run", model)
    assert export(tmp_path / "run", tmp_path / "out", model, merged=True) == ["language", "vision", "projector"]
    merged = merge_lora(variables, model.lora)["params"]
    language = read_language(tmp_path / "out" / "language")
    vision = read_vision(tmp_path / "out" / "vision", projection=model.vision.embed_width is not None)
    assert (language.config, vision.config) == (model.language, model.vision)
    assert not language.unused
    assert not vision.unused
    close = lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-6)  # noqa: E731
    jax.tree.map(close, language.load(), merged["language"])
    jax.tree.map(close, vision.load(), merged["vision"])
    stored = load_file(tmp_path / "out" / "projector" / "model.safetensors")
    expected = {
        ".".join(str(key.key) for key in path): np.asarray(leaf)
        for path, leaf in jax.tree_util.tree_leaves_with_path(variables["params"]["projector"])
    }
    assert_same(stored, expected)
    assert (tmp_path / "out" / "policy.json").read_text() == (tmp_path / "run" / "policy.json").read_text()


def test_adapters_have_pefts_names_shapes_and_settings(run, tmp_path):
    folder, variables = run
    out = tmp_path / "out"
    assert export(folder, out, bases={"language": "owner/llama"}) == ["language", "vision", "projector"]
    tensors = load_file(out / "language" / "adapter_model.safetensors")
    assert len(tensors) == 2 * 7 * 3
    down = variables["lora"]["language"]["layers"]["down"]
    stem = "base_model.model.model.layers.2.mlp.down_proj"
    np.testing.assert_array_equal(tensors[f"{stem}.lora_A.weight"], down["a"][2].T)
    np.testing.assert_array_equal(tensors[f"{stem}.lora_B.weight"], down["b"][2].T)
    tensors = load_file(out / "vision" / "adapter_model.safetensors")
    assert len(tensors) == 2 * 6 * 2
    stem = "base_model.model.encoder.layers.1.self_attn.out_proj"
    np.testing.assert_array_equal(
        tensors[f"{stem}.lora_A.weight"], variables["lora"]["vision"]["layers"]["o"]["a"][1].T
    )
    settings = json.loads((out / "language" / "adapter_config.json").read_text())
    assert (settings["r"], settings["lora_alpha"], settings["use_rslora"]) == (3, 7, False)
    assert settings["base_model_name_or_path"] == "owner/llama"
    assert settings["target_modules"] == sorted(
        ["q_proj", "k_proj", "v_proj", "o_proj", "gate_proj", "up_proj", "down_proj"]
    )
    settings = json.loads((out / "vision" / "adapter_config.json").read_text())
    assert settings["target_modules"] == sorted(["q_proj", "k_proj", "v_proj", "out_proj", "fc1", "fc2"])
    assert settings["base_model_name_or_path"] is None


def test_only_towers_and_layers_with_adapters_are_written(tmp_path):
    write_run(tmp_path / "run", PROMPTED)
    assert export(tmp_path / "run", tmp_path / "out", PROMPTED) == ["language", "projector"]
    settings = json.loads((tmp_path / "out" / "language" / "adapter_config.json").read_text())
    assert settings["target_modules"] == ["q_proj", "up_proj"]


def test_shards_keep_their_size_and_are_read_back_alike(run, tmp_path):
    folder = run[0]
    export(folder, tmp_path / "one", merged=True)
    export(folder, tmp_path / "many", merged=True, shard_bytes=6000)
    shards = sorted((tmp_path / "many" / "language").glob("model-*.safetensors"))
    assert len(shards) > 3
    largest = 4 * CONFIG.language.vocab_size * CONFIG.language.width
    index = json.loads((tmp_path / "many" / "language" / "model.safetensors.index.json").read_text())
    total = 0
    for shard in shards:
        size = {key: array.nbytes for key, array in load_file(shard).items()}
        assert sum(size.values()) <= 6000 or size == {next(iter(size)): largest}
        assert all(index["weight_map"][key] == shard.name for key in size)
        total += sum(size.values())
    assert index["metadata"]["total_size"] == total
    for read, tower in ((read_language, "language"), (read_vision, "vision")):
        assert_same(read(tmp_path / "many" / tower).load(), read(tmp_path / "one" / tower).load())


def test_bfloat16_is_the_rounded_merge_and_half_the_size(run, tmp_path):
    folder, variables = run
    export(folder, tmp_path / "half", merged=True, dtype=jnp.bfloat16)
    read = read_language(tmp_path / "half" / "language").load()
    merged = merge_lora(variables, LORA)["params"]["language"]
    assert_same(read, jax.tree.map(lambda x: np.asarray(x.astype(jnp.bfloat16).astype(jnp.float32)), merged))
    export(folder, tmp_path / "full", merged=True)
    sizes = [(tmp_path / name / "vision" / "model.safetensors").stat().st_size for name in ("half", "full")]
    assert sizes[0] < 0.6 * sizes[1]
    assert json.loads((tmp_path / "half" / "vision" / "config.json").read_text())["torch_dtype"] == "bfloat16"


def test_unmerging_gives_the_base_back(run):
    _, variables = run
    back = unmerge_lora(merge_lora(variables, LORA), variables["lora"], LORA)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), back, variables)


def test_a_whole_model_trained_without_adapters(tmp_path):
    model = dataclasses.replace(CONFIG, lora=None)
    variables = write_run(tmp_path / "run", model, "full")
    with pytest.raises(UserError, match="has no adapters: export its whole models with --merged"):
        export(tmp_path / "run", tmp_path / "out", model)
    export(tmp_path / "run", tmp_path / "out", model, merged=True)
    assert_same(read_language(tmp_path / "out" / "language").load(), variables["params"]["language"])


def test_the_vocabulary_opens_as_tokenizers_own(run, tmp_path):
    folder, _ = run
    export(folder, tmp_path / "out", merged=True)
    theirs = Tokenizer.from_file(str(tmp_path / "out" / "language" / "tokenizer.json"))
    assert theirs.get_vocab_size() == TOKENIZER.vocab_size
    for text in ("Close the BOX.", "stack 02 red,blocks -100 3-4 -0 007 200: unheard (of)", "", "left arm [1, 2, -3]"):
        ids = theirs.encode(text).ids
        assert ids == [TOKENIZER.bos_id, *TOKENIZER.encode(text)]
    config = json.loads((tmp_path / "out" / "language" / "config.json").read_text())
    assert (config["bos_token_id"], config["eos_token_id"]) == (TOKENIZER.bos_id, TOKENIZER.eos_id)


def test_an_existing_folder_is_not_touched(run, tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(CheckpointError, match="exists already"):
        export(run[0], tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_failed_export_leaves_nothing(run, tmp_path, monkeypatch):
    """A disk that is full in the middle of the second tower."""
    wide = tmp_path / "runs" / "out"
    monkeypatch.setitem(sys.modules["dsvla_jax.weights.export"].AXES, "patch_kernel", (0, 1))
    with pytest.raises(ValueError, match="axes"):
        export(run[0], wide, merged=True)
    assert list(wide.parent.iterdir()) == []


def test_what_a_killed_export_left_is_no_hindrance(run, tmp_path):
    (tmp_path / "out.partial" / "language").mkdir(parents=True)
    (tmp_path / "out.partial" / "language" / "model.safetensors").write_bytes(b"half of it")
    export(run[0], tmp_path / "out")
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
    assert not (tmp_path / "out" / "language" / "model.safetensors").exists()


def test_adapters_that_the_visual_prompt_does_not_see_are_not_merged(tmp_path):
    model = dataclasses.replace(PROMPTED, lora=LORA)
    write_run(tmp_path / "run", model)
    with pytest.raises(UserError, match=r"cannot be merged with fusion 'adapter'.*without --merged"):
        export(tmp_path / "run", tmp_path / "out", model, merged=True)
    assert not (tmp_path / "out").exists()
    assert export(tmp_path / "run", tmp_path / "out", model) == ["language", "vision", "projector"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"merged": True, "shard_bytes": 0.0}, "size of a file: expected more than 0 GB, got 0"),
        ({"merged": True, "shard_bytes": -1e9}, "expected more than 0 GB, got -1"),
        ({"merged": True, "shard_bytes": float("nan")}, "expected more than 0 GB, got nan"),
        ({"merged": True, "bases": {"language": "a/b", "vision": None}}, "a base is noted in adapters only"),
    ],
)
def test_options_that_mean_nothing_are_refused(run, tmp_path, options, message):
    with pytest.raises(UserError, match=message):
        export(run[0], tmp_path / "out", **options)
    assert not list(tmp_path.iterdir())


def test_a_base_for_a_tower_without_adapters_is_refused(tmp_path):
    model = dataclasses.replace(CONFIG, lora=dataclasses.replace(LORA, towers=("language",)))
    write_run(tmp_path / "run", model)
    with pytest.raises(UserError, match="no adapters in its vision tower: leave out that tower's base"):
        export(tmp_path / "run", tmp_path / "out", model, bases={"vision": "a/b"})
    assert not (tmp_path / "out").exists()


def test_a_run_of_another_size_is_refused(run, tmp_path):
    wider = dataclasses.replace(CONFIG, language=dataclasses.replace(CONFIG.language, ffn=32))
    with pytest.raises(CheckpointError, match=r"of another model: .*down.*expected"):
        export(run[0], tmp_path / "out", wider)


def test_command_line(run, tmp_path, monkeypatch, capsys):
    arguments = ["export", str(run[0]), str(tmp_path / "out"), "--merged", "--dtype", "bfloat16"]
    monkeypatch.setattr(sys, "argv", ["weights", *arguments])
    program.main()
    assert f"written: {tmp_path / 'out'} (language, vision, projector)" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        program.main()
    assert "exists already" in capsys.readouterr().err
    monkeypatch.setattr(sys, "argv", ["weights", "export", str(tmp_path), str(tmp_path / "other")])
    with pytest.raises(SystemExit):
        program.main()
    assert "no run here" in capsys.readouterr().err
