"""CLIP vision towers as OpenAI published them: one PyTorch file, a state dict or a TorchScript archive.

Names: openai/CLIP, clip/model.py.
"""

import dataclasses
import math
import re
from collections.abc import Mapping
from pathlib import Path

from dsvla_jax.model.config import VisionConfig
from dsvla_jax.weights.readers.torch_files import list_tensors
from dsvla_jax.weights.stored_tensors import StoredTensor, WeightsError
from dsvla_jax.weights.towers import AXES, Tower, assign, find_prefix, tower_shapes

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


def read_vision(file: Path, projection: bool = False) -> Tower[VisionConfig]:
    """The vision transformer of a CLIP file: a state dict, or the TorchScript archive that OpenAI published.

    projection: read the projection into CLIP's joint embedding too.
    Raises WeightsError naming file and key where anything is missing, left over, or of another shape or kind.
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
