"""Backbones as their authors published them: Meta's LLaMA folders and OpenAI's CLIP files.

Names: meta-llama/llama, llama/model.py; openai/CLIP, clip/model.py.
"""

import dataclasses
import math
import re
from collections.abc import Mapping
from pathlib import Path

from dsvla_jax.model.config import LanguageConfig, RopeScaling, VisionConfig
from dsvla_jax.model.llama import rotary_frequencies
from dsvla_jax.weights.configs import Section
from dsvla_jax.weights.safetensors import read_json
from dsvla_jax.weights.tensors import StoredTensor, WeightsError
from dsvla_jax.weights.torch_files import list_tensors
from dsvla_jax.weights.towers import AXES, Tower, assign, find_prefix, tower_shapes

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

_CLIP_LAYERS = {
    "ln_pre/scale": "ln_pre",
    "ln_post/scale": "ln_post",
    "layers/attention_norm/scale": "transformer.resblocks.{}.ln_1",
    "layers/mlp_norm/scale": "transformer.resblocks.{}.ln_2",
    "layers/o/kernel": "transformer.resblocks.{}.attn.out_proj",
    "layers/up/kernel": "transformer.resblocks.{}.mlp.c_fc",
    "layers/down/kernel": "transformer.resblocks.{}.mlp.c_proj",
}
# Queries, keys and values are made by one matrix, in this order.
IN_PROJECTION = "attn.in_proj_"
CLIP_NAMES = {
    "patch_kernel": "conv1.weight",
    "class_embedding": "class_embedding",
    "positional_embedding": "positional_embedding",
    "projection": "proj",
    **{ours: f"{theirs}.weight" for ours, theirs in _CLIP_LAYERS.items()},
    **{f"{ours.rsplit('/', 1)[0]}/bias": f"{theirs}.bias" for ours, theirs in _CLIP_LAYERS.items()},
    **{
        f"layers/{name}/{ours}": f"transformer.resblocks.{{}}.{IN_PROJECTION}{theirs}[{name}]"
        for name in "qkv"
        for ours, theirs in (("kernel", "weight"), ("bias", "bias"))
    },
}


def read_meta_language(folder: Path) -> Tower:
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


def read_openai_vision(file: Path, projection: bool = False) -> Tower:
    """The vision transformer of a CLIP file: a state dict, or the TorchScript archive that OpenAI published.

    projection: read the projection into CLIP's joint embedding too. Raises WeightsError as `read_meta_language` does.
    """
    tensors = list_tensors(file)
    prefix = find_prefix(tensors, "visual.class_embedding", file) + "visual."
    config = _clip_config({key.removeprefix(prefix): t for key, t in tensors.items() if key.startswith(prefix)}, file)
    if not projection:
        config = dataclasses.replace(config, embed_width=None)
    names = {ours: prefix + theirs for ours, theirs in CLIP_NAMES.items()}
    droppable = () if projection else (names["projection"],)
    return assign(
        config,
        tower_shapes(config),
        names,
        split_in_projections(tensors),
        file,
        prefix=prefix,
        droppable=droppable,
        axes={**AXES, "projection": (0, 1)},
    )


def split_in_projections(tensors: Mapping[str, StoredTensor]) -> dict[str, StoredTensor]:
    """Each matrix and bias that makes queries, keys and values as three tensors."""
    split: dict[str, StoredTensor] = {}
    for key, tensor in tensors.items():
        if IN_PROJECTION not in key or not tensor.shape or tensor.shape[0] % 3:
            split[key] = tensor
            continue
        third = tensor.shape[0] // 3
        split |= {f"{key}[{name}]": tensor.rows(i * third, (i + 1) * third) for i, name in enumerate("qkv")}
    return split


def _clip_config(tensors: Mapping[str, StoredTensor], file: Path) -> VisionConfig:
    """The sizes that openai/CLIP reads from the tensors too; a head is 64 wide."""

    def shape(key: str, axes: int) -> tuple[int, ...]:
        if key not in tensors or len(tensors[key].shape) != axes:
            raise WeightsError(
                f"{file}: wrong architecture: expected visual.{key} with {axes} axes, as CLIP's ViTs have it"
            )
        return tensors[key].shape

    width, _, _, patch = shape("conv1.weight", 4)
    grid = math.isqrt(max(shape("positional_embedding", 2)[0] - 1, 0))
    layers = {match[1] for key in tensors if (match := re.match(r"transformer\.resblocks\.(\d+)\.", key))}
    try:
        return VisionConfig(
            image_size=grid * patch,
            patch_size=patch,
            width=width,
            layers=len(layers),
            heads=max(width // 64, 1),
            mlp_ratio=shape("transformer.resblocks.0.mlp.c_fc.weight", 2)[0] / width,
            embed_width=shape("proj", 2)[1],
        )
    except (ValueError, ZeroDivisionError) as error:
        raise WeightsError(f"{file}: {error}") from error
