"""LLaMA decoders of GGUF files, quantised or not: read with the package gguf, which knows the formats of the numbers.

ggml-org/ggml, docs/gguf.md (keys of the metadata); ggml-org/llama.cpp, gguf-py.
"""

import dataclasses
from pathlib import Path
from types import ModuleType

import numpy as np

from dsvla_jax.model.config import LanguageConfig
from dsvla_jax.weights.readers.hugging_face_config import Section
from dsvla_jax.weights.stored_tensors import AGAIN, StoredTensor, WeightsError
from dsvla_jax.weights.towers import Tower, assign, tower_shapes

_LINEAR = {
    **{name: f"attn_{name}" for name in "qkv"},
    "o": "attn_output",
    **{name: f"ffn_{name}" for name in ("gate", "up", "down")},
}
NAMES = {
    "embedding": "token_embd.weight",
    "norm/scale": "output_norm.weight",
    "output": "output.weight",
    "layers/attention_norm/scale": "blk.{}.attn_norm.weight",
    "layers/mlp_norm/scale": "blk.{}.ffn_norm.weight",
    **{f"layers/{ours}/kernel": f"blk.{{}}.{theirs}.weight" for ours, theirs in _LINEAR.items()},
}


# What the metadata of a LLaMA may say. context_length only bounds, and the layout follows from the names.
KEYS = (
    *("context_length", "embedding_length", "block_count", "feed_forward_length", "vocab_size", "tensor_data_layout"),
    *("attention.head_count", "attention.head_count_kv", "attention.key_length", "attention.value_length"),
    *("attention.layer_norm_rms_epsilon", "expert_count", "expert_used_count"),
    *("rope.dimension_count", "rope.freq_base", "rope.scaling.type", "rope.scaling.factor", "rope.scale_linear"),
    *("rope.scaling.original_context_length", "rope.scaling.finetuned"),
)


@dataclasses.dataclass(frozen=True)
class QuantizedTensor(StoredTensor):
    """A tensor in one of GGML's formats: blocks of numbers along the last axis. dtype: the format's name."""

    def check(self) -> None:
        """Raises WeightsError if the format is not read, or the blocks do not fill their bytes."""
        quants = _package().quants
        kind = _package().GGMLQuantizationType[self.dtype]
        try:
            row = quants.quant_shape_to_byte_shape(self.shape, kind)
            quants.dequantize(np.zeros(row[-1], np.uint8), kind)
        except (ValueError, NotImplementedError) as error:
            raise WeightsError(f"{self.file}: {self.key}: {self.dtype} {self.shape} is not read: {error}") from error
        if self.end > self.file.stat().st_size or self.end - self.begin != int(np.prod(row)):
            raise WeightsError(f"{self.file}: {self.key}: does not fill its bytes, or ends behind the file; {AGAIN}")

    def _decode(self, content: np.ndarray) -> np.ndarray:
        return _package().quants.dequantize(content, _package().GGMLQuantizationType[self.dtype])


def _package() -> ModuleType:
    try:
        import gguf  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise WeightsError("GGUF files need the package gguf: pip install gguf") from error
    return gguf


def read_language(file: Path) -> Tower[LanguageConfig]:
    """The LLaMA decoder of a GGUF file, its numbers dequantised as they are read.

    Raises WeightsError naming file and key where anything is missing, left over, damaged, or of another architecture.
    """
    if not file.is_file():
        raise WeightsError(f"{file}: missing; expected a GGUF file")
    try:
        reader = _package().GGUFReader(file)
    except (ValueError, IndexError, KeyError, OverflowError) as error:
        raise WeightsError(f"{file}: not a GGUF file, or cut short ({error}); {AGAIN}") from error
    values = {name: field.contents() for name, field in reader.fields.items() if not name.startswith("tokenizer.")}
    architecture = values.get("general.architecture")
    if architecture != "llama":
        raise WeightsError(f"{file}: wrong architecture: expected general.architecture 'llama', found {architecture!r}")
    tensors = {
        tensor.name: QuantizedTensor(
            tensor.name,
            file,
            tensor.tensor_type.name,
            tuple(int(size) for size in reversed(tensor.shape)),
            int(tensor.data_offset),
            int(tensor.data_offset) + int(tensor.n_bytes),
        )
        for tensor in reader.tensors
    }
    own = {name: value for name, value in values.items() if name.startswith("llama.")}
    section = Section(file, {name.removeprefix("llama."): value for name, value in own.items()})
    config = _config(section, tensors)
    rotated = ("attn_q.weight", "attn_k.weight")
    paired = {
        key: dataclasses.replace(tensor, head_dim=config.head_dim) if key.endswith(rotated) else tensor
        for key, tensor in tensors.items()
    }
    return assign(config, tower_shapes(config), NAMES, paired, file)


def _config(section: Section, tensors: dict[str, QuantizedTensor]) -> LanguageConfig:
    embedding = tensors.get(NAMES["embedding"])
    if embedding is None:
        raise WeightsError(f"{section.file}: {NAMES['embedding']} is missing")
    section.only(KEYS, "metadata of a LLaMA")
    section.require("rope.scaling.type", "none")
    for name in ("rope.scaling.factor", "rope.scale_linear"):
        section.require(name, 1.0)
    for name in ("expert_count", "expert_used_count"):
        section.require(name, 0)
    width, heads = section.integer("embedding_length", 0), section.integer("attention.head_count", 0)
    head_dim = section.integer("attention.key_length", width // heads)
    section.require("rope.dimension_count", head_dim)
    section.require("attention.value_length", head_dim)
    section.require("vocab_size", embedding.shape[0])
    try:
        return LanguageConfig(
            vocab_size=embedding.shape[0],
            width=width,
            layers=section.integer("block_count", 0),
            heads=heads,
            kv_heads=section.integer("attention.head_count_kv", heads),
            ffn=section.integer("feed_forward_length", 0),
            rope_theta=section.positive("rope.freq_base", 10000.0),
            norm_eps=section.positive("attention.layer_norm_rms_epsilon", 1e-5),
            tie_embeddings=NAMES["output"] not in tensors,
            explicit_head_dim=None if head_dim * heads == width else head_dim,
        )
    except ValueError as error:
        raise WeightsError(f"{section.file}: {error}") from error
