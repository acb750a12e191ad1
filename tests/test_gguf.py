"""GGUF files, written with the package that defines them. Skipped where it is not installed (extra `gguf`)."""

from pathlib import Path

import numpy as np
import pytest

from dsvla_jax.model.config import LanguageConfig
from dsvla_jax.weights.readers.any_format import read_language
from dsvla_jax.weights.stored_tensors import WeightsError

gguf = pytest.importorskip("gguf", reason="needs the package gguf: pip install gguf")

LAYERS, WIDTH, HEADS, KV_HEADS, HEAD_DIM, FFN, VOCAB = 2, 64, 4, 2, 16, 96, 31
NAMES = {
    **{name: (f"attn_{name}", size) for name, size in (("q", HEADS * HEAD_DIM), ("k", 32), ("v", 32))},
    "o": ("attn_output", WIDTH),
    **{name: (f"ffn_{name}", WIDTH if name == "down" else FFN) for name in ("gate", "up", "down")},
}


def draw_model() -> dict[str, np.ndarray]:
    """Parameters as the model has them, by path and layer."""
    random = np.random.default_rng(0)
    inputs = {"o": HEADS * HEAD_DIM, "down": FFN}
    values = {"token_embd": (VOCAB, WIDTH), "output_norm": (WIDTH,), "output": (VOCAB, WIDTH)}
    for layer in range(LAYERS):
        values |= {f"blk.{layer}.{name}": (WIDTH,) for name in ("attn_norm", "ffn_norm")}
        values |= {f"blk.{layer}.{theirs}": (out, inputs.get(n, WIDTH)) for n, (theirs, out) in NAMES.items()}
    return {name: random.standard_normal(shape).astype(np.float32) for name, shape in values.items()}


def write_gguf(file: Path, tensors: dict[str, np.ndarray], kind: str, **changes) -> Path:
    """Queries and keys with rotary pairs side by side, as llama.cpp keeps them. kind: of the matrices."""
    writer = gguf.GGUFWriter(file, changes.pop("architecture", "llama"))
    fields = {
        "embedding_length": WIDTH,
        "block_count": LAYERS,
        "feed_forward_length": FFN,
        "attention.head_count": HEADS,
        "attention.head_count_kv": KV_HEADS,
        "rope.dimension_count": HEAD_DIM,
    }
    for name, value in (fields | changes).items():
        writer.add_uint32(f"llama.{name}", value)
    writer.add_float32("llama.attention.layer_norm_rms_epsilon", 1e-5)
    for name, values in tensors.items():
        if name.endswith(("attn_q", "attn_k")):
            values = values.reshape(-1, 2, HEAD_DIM // 2, WIDTH).swapaxes(1, 2).reshape(values.shape)
        stored = gguf.GGMLQuantizationType[kind if values.ndim > 1 else "F32"]
        writer.add_tensor(f"{name}.weight", gguf.quants.quantize(values, stored), raw_dtype=stored)
    writer.write_header_to_file()
    writer.write_kv_data_to_file()
    writer.write_tensors_to_file()
    writer.close()
    return file


@pytest.mark.parametrize(
    ("kind", "step"), [("F32", 0), ("F16", 2**-11), ("BF16", 2**-8), ("Q8_0", 2**-7), ("Q4_1", 2**-4)]
)
def test_every_number_is_in_its_place(tmp_path, kind, step):
    model = draw_model()
    params = read_language(write_gguf(tmp_path / "model.gguf", model, kind)).load()
    expected = {"embedding": model["token_embd"], "output": model["output"].T}
    for path, values in expected.items():
        np.testing.assert_allclose(params[path], values, rtol=0, atol=step * np.abs(values).max())
    for layer in range(LAYERS):
        for ours, (theirs, _) in NAMES.items():
            values = model[f"blk.{layer}.{theirs}"].T
            read = params["layers"][ours]["kernel"][layer]
            np.testing.assert_allclose(read, values, rtol=0, atol=step * np.abs(values).max())
        norm = params["layers"]["mlp_norm"]["scale"][layer]
        np.testing.assert_array_equal(norm, model[f"blk.{layer}.ffn_norm"])


def test_an_absent_output_is_the_embedding(tmp_path):
    model = draw_model()
    del model["output"]
    assert read_language(write_gguf(tmp_path / "model.gguf", model, "F32")).config.tie_embeddings


def test_a_stored_output_is_used_even_if_it_is_the_embedding(tmp_path):
    """The format has no word on tied tables: llama.cpp takes the output's where there is one."""
    model = draw_model()
    model["output"] = model["token_embd"]
    tower = read_language(write_gguf(tmp_path / "model.gguf", model, "F32"))
    assert isinstance(tower.config, LanguageConfig)
    assert not tower.config.tie_embeddings
    np.testing.assert_array_equal(tower.load()["output"], model["output"].T)


def without(name):
    return lambda file: write_gguf(file, {k: v for k, v in draw_model().items() if k != name}, "F32")


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (lambda f: write_gguf(f, draw_model(), "F32", architecture="qwen2"), "expected general.architecture 'llama'"),
        (without("blk.1.attn_v"), r"model\.gguf: .*missing: blk.1.attn_v.weight"),
        (without("token_embd"), r"model\.gguf: token_embd.weight is missing"),
        (
            lambda f: write_gguf(f, draw_model() | {"rope_freqs": np.ones(8, np.float32)}, "F32"),
            "no place .* rope_freqs",
        ),
        (lambda f: write_gguf(f, draw_model(), "F32", block_count=1), "no place in this architecture for: blk.1"),
        (
            lambda f: write_gguf(f, draw_model(), "F32", feed_forward_length=64),
            r"blk.0.ffn_down.weight: expected shape \(64, 64\) .* found \(64, 96\)",
        ),
        (lambda f: write_gguf(f, draw_model(), "F32", **{"rope.dimension_count": 8}), "rope.dimension_count: only 16"),
        (lambda f: write_gguf(f, draw_model(), "F32", **{"rope.scale_linear": 4}), "rope.scale_linear: only 1.0"),
        (lambda f: write_gguf(f, draw_model(), "F32", **{"attention.value_length": 8}), "value_length: only 16"),
        (lambda f: write_gguf(f, draw_model(), "F32", expert_count=8), "expert_count: only 0"),
        (lambda f: write_gguf(f, draw_model(), "F32", vocab_size=30), "vocab_size: only 31"),
        (lambda f: write_gguf(f, draw_model(), "F32", final_logit_softcapping=30), "found final_logit_softcapping: 30"),
        (lambda f: f.write_bytes(b"GGUX" + bytes(100)), r"model\.gguf: not a GGUF file, or cut short"),
        (lambda f: f.touch(), r"model\.gguf: not a GGUF file, or cut short"),
        (lambda f: None, r"model\.gguf: missing"),
    ],
)
def test_files_that_do_not_fit_say_why(tmp_path, write, message):
    write(tmp_path / "model.gguf")
    with pytest.raises(WeightsError, match=message):
        read_language(tmp_path / "model.gguf")


def test_a_file_cut_anywhere_is_an_error(tmp_path):
    file = write_gguf(tmp_path / "model.gguf", draw_model(), "Q8_0")
    content = file.read_bytes()
    for keep in range(0, len(content), len(content) // 23):
        file.write_bytes(content[:keep])
        with pytest.raises(WeightsError, match=r"model\.gguf"):
            read_language(file)
