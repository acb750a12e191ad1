"""LLaMA decoders as Meta published them: folders with params.json and consolidated.00.pth.

Names: meta-llama/llama, llama/model.py.
"""

import dataclasses
import re
from collections.abc import Mapping
from pathlib import Path

from dsvla_jax.model.config import LanguageConfig, RopeScaling
from dsvla_jax.model.llama import rotary_frequencies
from dsvla_jax.weights.readers.hugging_face_config import Section
from dsvla_jax.weights.readers.safetensors import read_json
from dsvla_jax.weights.readers.torch_files import list_tensors
from dsvla_jax.weights.stored_tensors import StoredTensor, WeightsError
from dsvla_jax.weights.towers import Tower, assign, tower_shapes

PARAMS = "params.json"
# What it may say. The sizes that multiple_of and ffn_dim_multiplier decide are those of the tensors.
PARAMS_READ = (
    *("dim", "n_layers", "n_heads", "n_kv_heads", "vocab_size", "norm_eps", "rope_theta", "use_scaled_rope"),
    *("multiple_of", "ffn_dim_multiplier", "max_batch_size", "max_seq_len", "model_parallel_size"),
)
# A constant that Meta's files have beside the parameters, and that Meta's code does not read.
FREQUENCIES = "rope.freqs"

META_LINEAR = {
    **{name: f"attention.w{name}" for name in "qkvo"},
    "gate": "feed_forward.w1",
    "up": "feed_forward.w3",
    "down": "feed_forward.w2",
}
META_BLOCKS = {
    "attention_norm/scale": "layers.{}.attention_norm.weight",
    "mlp_norm/scale": "layers.{}.ffn_norm.weight",
    **{f"{ours}/kernel": f"layers.{{}}.{theirs}.weight" for ours, theirs in META_LINEAR.items()},
}
META_NAMES = {
    "embedding": "tok_embeddings.weight",
    "norm/scale": "norm.weight",
    "output": "output.weight",
    **{f"layers/{ours}": theirs for ours, theirs in META_BLOCKS.items()},
}
# Meta rotates neighbouring numbers of a head; what makes queries and keys is to be read in that order.
ROTATED = re.compile(r"\bw[qk]\.(weight|bias)$|\blora_w[qk]_l2\.weight$")


def read_language(folder: Path) -> Tower[LanguageConfig]:
    """The LLaMA decoder of a folder with params.json and one consolidated.00.pth.

    Raises WeightsError naming file and key where anything is missing, left over, or of another shape or kind.
    """
    files = sorted(folder.glob("consolidated.*.pth"))
    if len(files) != 1:
        found = ", ".join(file.name for file in files) or "none"
        raise WeightsError(
            f"{folder}: expected one file consolidated.00.pth, found {found}; models in several parallel parts are "
            "read as Hugging Face folders only"
        )
    tensors = list_tensors(files[0])
    config = _meta_config(Section(folder / PARAMS, read_json(folder / PARAMS)), tensors, files[0])
    tensors = in_rotary_pairs(tensors, config.head_dim)
    notes = ()
    unscaled = dataclasses.replace(config, rope_scaling=None)
    if FREQUENCIES in tensors and not tensors[FREQUENCIES].holds(rotary_frequencies(unscaled)):
        notes = (f"{FREQUENCIES} differs from what {PARAMS} says, which alone is used, as in Meta's code",)
    shapes = tower_shapes(config)
    return assign(config, shapes, META_NAMES, tensors, files[0], droppable=(FREQUENCIES,), notes=notes)


def in_rotary_pairs(tensors: Mapping[str, StoredTensor], head_dim: int) -> dict[str, StoredTensor]:
    """The tensors, those of queries and keys marked to be read in the model's order of a head's numbers."""
    return {
        key: dataclasses.replace(tensor, head_dim=head_dim) if ROTATED.search(key) else tensor
        for key, tensor in tensors.items()
    }


def _meta_config(section: Section, tensors: Mapping[str, StoredTensor], file: Path) -> LanguageConfig:
    """Sizes that params.json leaves open (vocabulary, hidden width) are those of the tensors."""

    def rows(key: str) -> int:
        if key not in tensors or not tensors[key].shape:
            raise WeightsError(f"{file}: wrong architecture: {key} is missing")
        return tensors[key].shape[0]

    section.only(PARAMS_READ, "sizes of a LLaMA")
    heads = section.integer("n_heads", 32)
    scaled = section.flag("use_scaled_rope")
    vocab_size = rows("tok_embeddings.weight")
    if section.number("vocab_size", -1) > 0:  # the first LLaMA's says -1
        section.require("vocab_size", vocab_size)
    try:
        return LanguageConfig(
            vocab_size=vocab_size,
            width=section.integer("dim", 4096),
            layers=section.integer("n_layers", 32),
            heads=heads,
            kv_heads=section.integer("n_kv_heads", heads),
            ffn=rows("layers.0.feed_forward.w1.weight"),
            rope_theta=section.positive("rope_theta", 10000.0),
            norm_eps=section.positive("norm_eps", 1e-5),
            tie_embeddings=False,
            rope_scaling=RopeScaling() if scaled else None,
        )
    except ValueError as error:
        raise WeightsError(f"{section.file}: {error}") from error
