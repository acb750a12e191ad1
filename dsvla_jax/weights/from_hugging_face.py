"""LLaMA decoders and CLIP vision towers of Hugging Face folders: config.json and safetensors.

Names are those of transformers' LlamaForCausalLM and CLIPVisionModel behind whatever prefix the checkpoint puts in
front of them ("model.", "vision_model.", "vision_tower.vision_model.", nothing).
"""

import dataclasses
from pathlib import Path

from dsvla_jax.weights.configs import read_language_config, read_vision_config
from dsvla_jax.weights.safetensors import list_tensors
from dsvla_jax.weights.tensors import WeightsError
from dsvla_jax.weights.towers import Tower, assign, find_prefix, tower_shapes

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

# Constants that old versions of transformers saved with the parameters.
BUFFERS = ("rotary_emb.inv_freq", "embeddings.position_ids")


def read_language(folder: Path) -> Tower:
    """The LLaMA decoder of a folder: params of `dsvla_jax.model.llama.Llama`.

    Raises WeightsError naming file and key where anything is missing, left over within the decoder, of another shape
    than config.json says, or of numbers that are not read here.
    """
    config = read_language_config(folder)
    tensors = list_tensors(folder)
    prefix = find_prefix(tensors, LLAMA_NAMES["embedding"], folder)
    names = {ours: prefix + theirs for ours, theirs in LLAMA_NAMES.items()}
    names["output"] = prefix.removesuffix("model.") + LM_HEAD
    droppable = BUFFERS + ((LM_HEAD,) if config.tie_embeddings else ())
    return assign(config, tower_shapes(config), names, tensors, folder, prefix=prefix, droppable=droppable)


def read_vision(folder: Path, projection: bool = False) -> Tower:
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
    return assign(config, tower_shapes(config), names, tensors, folder, prefix=prefix, droppable=BUFFERS)
