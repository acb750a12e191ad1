"""LLaMA decoders and CLIP vision towers of Hugging Face folders: config.json and safetensors.

Names are those of transformers' LlamaForCausalLM and CLIPVisionModel behind whatever prefix the checkpoint puts in
front of them ("model.", "vision_model.", "vision_tower.vision_model.", nothing).
"""

import dataclasses
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from dsvla_jax.model.config import LanguageConfig, VisionConfig
from dsvla_jax.model.llama import rotary_frequencies
from dsvla_jax.weights.readers.hugging_face_config import read_language_config, read_vision_config
from dsvla_jax.weights.readers.safetensors import list_tensors
from dsvla_jax.weights.stored_tensors import WeightsError
from dsvla_jax.weights.towers import Tower, assign, find_prefix, summarize, tower_shapes

_LLAMA_LINEAR = {
    **{name: f"self_attn.{name}_proj" for name in "qkvo"},
    **{name: f"mlp.{name}_proj" for name in ("gate", "up", "down")},
}
LLAMA_NAMES = {
    "embedding": "embed_tokens.weight",
    "norm/scale": "norm.weight",
    "layers/attention_norm/scale": "layers.{}.input_layernorm.weight",
    "layers/mlp_norm/scale": "layers.{}.post_attention_layernorm.weight",
    **{f"layers/{ours}/kernel": f"layers.{{}}.{theirs}.weight" for ours, theirs in _LLAMA_LINEAR.items()},
    **{f"layers/{ours}/bias": f"layers.{{}}.{theirs}.bias" for ours, theirs in _LLAMA_LINEAR.items()},
}
LM_HEAD = "lm_head.weight"
VISUAL_PROJECTION = "visual_projection.weight"

# With weight and bias each, the weight being our `kernel` or `scale`.
_CLIP_LAYERS = {
    "ln_pre/scale": "pre_layrnorm",  # sic, in every published checkpoint
    "ln_post/scale": "post_layernorm",
    "layers/attention_norm/scale": "encoder.layers.{}.layer_norm1",
    "layers/mlp_norm/scale": "encoder.layers.{}.layer_norm2",
    **{f"layers/{name}/kernel": f"encoder.layers.{{}}.self_attn.{name}_proj" for name in "qkv"},
    "layers/o/kernel": "encoder.layers.{}.self_attn.out_proj",
    "layers/up/kernel": "encoder.layers.{}.mlp.fc1",
    "layers/down/kernel": "encoder.layers.{}.mlp.fc2",
}
CLIP_NAMES = {
    "patch_kernel": "embeddings.patch_embedding.weight",
    "class_embedding": "embeddings.class_embedding",
    "positional_embedding": "embeddings.position_embedding.weight",
    **{ours: f"{theirs}.weight" for ours, theirs in _CLIP_LAYERS.items()},
    **{f"{ours.rsplit('/', 1)[0]}/bias": f"{theirs}.bias" for ours, theirs in _CLIP_LAYERS.items()},
}

# Constants that old versions of transformers saved with the parameters, and that new ones do not read.
FREQUENCIES, POSITIONS = ".rotary_emb.inv_freq", "embeddings.position_ids"


def read_language(folder: Path) -> Tower[LanguageConfig]:
    """The LLaMA decoder of a folder: params of `dsvla_jax.model.llama.Llama`.

    Raises WeightsError naming file and key where anything is missing, left over within the decoder, of another shape
    than config.json says, or of numbers that are not read here. Whether the embedding is the output too is told from
    the tensors, as transformers 5 tells it; where config.json says otherwise, a note of the tower does.
    """
    config = read_language_config(folder)
    tensors = list_tensors(folder)
    prefix = find_prefix(tensors, LLAMA_NAMES["layers/attention_norm/scale"].format(0), folder)
    names = {ours: prefix + theirs for ours, theirs in LLAMA_NAMES.items()}
    embedding, head = names["embedding"], _head_key(tensors, prefix, folder)
    names["output"] = head
    droppable, notes = [], []
    if config.tie_embeddings and head in tensors:
        if embedding not in tensors:
            names["embedding"] = head
            notes.append(f"{head} is the embedding too: tied, and stored under this name alone")
        elif tensors[embedding].equals(tensors[head]):
            droppable.append(head)
            notes.append(f"{head} equals {embedding}: tied, and kept once")
        else:
            config = dataclasses.replace(config, tie_embeddings=False)
            notes.append(
                f"{head} differs from {embedding}, though config.json says tie_word_embeddings: imported as it is "
                "stored, untied, as transformers 5 loads it (model.language.tie_embeddings: false)"
            )
    frequencies = [key for key in tensors if key.startswith(prefix) and key.endswith(FREQUENCIES)]
    if other := [key for key in frequencies if not tensors[key].holds(rotary_frequencies(config))]:
        notes.append(f"{summarize(other)} differs from what config.json says, which alone is used, as in transformers")
    return assign(
        config,
        tower_shapes(config),
        names,
        tensors,
        folder,
        prefix=(prefix, head.removesuffix("weight")),
        droppable=[*droppable, *frequencies],
        notes=tuple(notes),
    )


def _head_key(tensors: Iterable[str], prefix: str, folder: Path) -> str:
    """The name of the output's matrix: that of the closest model around the decoder, stored or not."""
    stems = [key.removesuffix(LM_HEAD) for key in tensors if key == LM_HEAD or key.endswith("." + LM_HEAD)]
    around = [stem for stem in stems if prefix.startswith(stem)]
    if stems and not around:
        raise WeightsError(
            f"{folder}: {', '.join(stem + LM_HEAD for stem in stems)}: of another model than the decoder "
            f"{prefix or 'without a prefix'}; keep the tensors of one model"
        )
    return max(around, key=len, default=prefix.removesuffix("model.")) + LM_HEAD


def read_vision(folder: Path, projection: bool = False) -> Tower[VisionConfig]:
    """The CLIP vision tower of a folder: params of `dsvla_jax.model.clip.VisionTower`.

    projection: read the projection into CLIP's joint embedding too, which only whole CLIP models have.
    Raises WeightsError as `read_language` does.
    """
    config = read_vision_config(folder)
    tensors = list_tensors(folder)
    prefix = find_prefix(tensors, CLIP_NAMES["class_embedding"], folder)
    names = {ours: prefix + theirs for ours, theirs in CLIP_NAMES.items()}
    if projection:
        key = names["projection"] = prefix.removesuffix("vision_model.") + VISUAL_PROJECTION
        if key not in tensors:
            raise WeightsError(f"{folder}: {key} is missing: this is a vision tower without CLIP's projection")
        config = dataclasses.replace(config, embed_width=tensors[key].shape[0])
    key, notes = prefix + POSITIONS, []
    if key in tensors and not tensors[key].holds(np.arange(1 + config.num_patches)):
        notes.append(f"{key} does not count up from 0; positions are used in their order, as in transformers")
    shapes = tower_shapes(config)
    return assign(config, shapes, names, tensors, folder, prefix=prefix, droppable=(key,), notes=tuple(notes))
