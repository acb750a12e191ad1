"""LLaMA decoders and CLIP vision towers of Hugging Face checkpoints, as parameters of `dsvla_jax.model`.

Names are those of transformers' LlamaForCausalLM and CLIPVisionModel behind whatever prefix the checkpoint puts in
front of them ("model.", "vision_model.", "vision_tower.vision_model.", nothing).
"""

import dataclasses
import math
import re
from collections import defaultdict
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import traverse_util
from tqdm import tqdm

from dsvla_jax.model.clip import VisionTower
from dsvla_jax.model.config import LanguageConfig, ModelConfig, VisionConfig
from dsvla_jax.model.llama import Llama
from dsvla_jax.weights.configs import read_language_config, read_vision_config
from dsvla_jax.weights.positions import resample_positions
from dsvla_jax.weights.safetensors import list_tensors
from dsvla_jax.weights.tensors import StoredTensor, WeightsError

LLAMA_NAMES = {
    "embedding": "embed_tokens.weight",
    "norm/scale": "norm.weight",
    "layers/attention_norm/scale": "layers.{}.input_layernorm.weight",
    "layers/mlp_norm/scale": "layers.{}.post_attention_layernorm.weight",
    **{f"layers/{name}/kernel": f"layers.{{}}.self_attn.{name}_proj.weight" for name in "qkvo"},
    **{f"layers/{name}/kernel": f"layers.{{}}.mlp.{name}_proj.weight" for name in ("gate", "up", "down")},
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

# Which of the stored axes becomes each of ours: (out, in) -> (in, out), (out, in, y, x) -> (y, x, in, out).
AXES = {"kernel": (1, 0), "output": (1, 0), "projection": (1, 0), "patch_kernel": (2, 3, 1, 0)}

# Constants that old versions of transformers saved with the parameters.
BUFFERS = ("rotary_emb.inv_freq", "embeddings.position_ids")


# Rows of a stored tensor that are in memory at a time; as many make a chunk of the folder that is written.
ROWS = 2048


@dataclasses.dataclass(frozen=True)
class Piece:
    """A stored tensor, and what it becomes: the parameter at ``path``, or one layer of it.

    axes: which of the stored axes becomes each of ours.
    """

    path: str
    layer: int | None
    tensor: StoredTensor
    axes: tuple[int, ...]

    def copy_to(self, array: Any, dtype: Any) -> None:
        """Writes the tensor, some rows at a time, to the parameter's array (NumPy or on disk) of ``dtype``."""
        place = self.axes.index(0)
        for start in range(0, self.tensor.shape[0], ROWS):
            rows = self.tensor.read(start, min(start + ROWS, self.tensor.shape[0]))
            index: list[Any] = [slice(None)] * len(self.axes)
            index[place] = slice(start, start + len(rows))
            whole_index = tuple(index) if self.layer is None else (self.layer, *index)
            array[whole_index] = rows.transpose(self.axes).astype(dtype)


@dataclasses.dataclass(frozen=True)
class Tower:
    """A tower of a checkpoint whose tensors are all there, and not read yet.

    shapes: of its parameters by path, layers stacked. computed: those that are not as they are stored, float32.
    unused: keys of the checkpoint left alone.
    """

    config: LanguageConfig | VisionConfig
    shapes: Mapping[str, tuple[int, ...]]
    pieces: tuple[Piece, ...]
    computed: Mapping[str, np.ndarray]
    unused: tuple[str, ...]

    @property
    def size(self) -> int:
        """How many numbers it has."""
        return sum(math.prod(shape) for shape in self.shapes.values())

    def copy_to(self, arrays: Mapping[str, Any], dtype: Any) -> None:
        """Fills the arrays (NumPy or on disk) of its parameters; few rows of one tensor are in memory at a time."""
        for path, values in self.computed.items():
            arrays[path][...] = values.astype(dtype)
        pieces = [piece for piece in self.pieces if piece.path not in self.computed]
        size = sum(math.prod(piece.tensor.shape) for piece in pieces)
        with tqdm(total=size, desc="import", unit="number", unit_scale=True, disable=None) as bar:
            for piece in pieces:
                piece.copy_to(arrays[piece.path], dtype)
                bar.update(math.prod(piece.tensor.shape))

    def load(self, dtype: Any = np.float32) -> dict[str, Any]:
        """Its parameters in memory, a nested dict."""
        arrays = {path: np.empty(shape, dtype) for path, shape in self.shapes.items()}
        self.copy_to(arrays, dtype)
        return traverse_util.unflatten_dict(arrays, sep="/")


def read_language(folder: Path) -> Tower:
    """The LLaMA decoder of a checkpoint: params of `dsvla_jax.model.llama.Llama`.

    Raises WeightsError naming file and key where anything is missing, left over within the decoder, of another shape
    than config.json says, or of numbers that are not read here.
    """
    config = read_language_config(folder)
    tensors = list_tensors(folder)
    prefix = _find_prefix(tensors, LLAMA_NAMES["embedding"], folder)
    head = prefix.removesuffix("model.") + LM_HEAD
    names = {ours: prefix + theirs for ours, theirs in LLAMA_NAMES.items()}
    if not config.tie_embeddings:
        names["output"] = head
    return _assign(config, names, tensors, prefix, (LM_HEAD,) if config.tie_embeddings else ())


def read_vision(folder: Path, image_size: int | None = None, projection: bool = False) -> Tower:
    """The CLIP vision tower of a checkpoint: params of `dsvla_jax.model.clip.VisionTower`.

    image_size: pixels; None for the checkpoint's own. Positional embeddings are resampled to another size's grid.
    projection: read the projection into CLIP's joint embedding too, which only whole CLIP models have.
    Raises WeightsError as `read_language` does.
    """
    config = read_vision_config(folder)
    tensors = list_tensors(folder)
    prefix = _find_prefix(tensors, CLIP_NAMES["class_embedding"], folder)
    names = {ours: prefix + theirs for ours, theirs in CLIP_NAMES.items()}
    if projection:
        key = names["projection"] = prefix.removesuffix("vision_model.") + VISUAL_PROJECTION
        if key not in tensors:
            raise WeightsError(f"{folder}: {key} is missing: this is a vision tower without CLIP's projection")
        config = dataclasses.replace(config, embed_width=tensors[key].shape[0])
    tower = _assign(config, names, tensors, prefix, ())
    return tower if image_size is None else _resample(tower, image_size, folder)


def _resample(tower: Tower, image_size: int, source: Path) -> Tower:
    """The vision tower for images of another size."""
    try:
        config = dataclasses.replace(tower.config, image_size=image_size)
    except ValueError as error:
        raise WeightsError(f"image size {image_size} does not suit the tower in {source}: {error}") from error
    assert isinstance(config, VisionConfig)
    name = "positional_embedding"
    stored = next(piece.tensor for piece in tower.pieces if piece.path == name)
    positions = resample_positions(stored.read().astype(np.float32), config.grid)
    return dataclasses.replace(
        tower, config=config, shapes={**tower.shapes, name: positions.shape}, computed={name: positions}
    )


def tower_shapes(config: LanguageConfig | VisionConfig) -> dict[str, Any]:
    """The tree of a tower's params, as float32 ShapeDtypeStructs."""
    if isinstance(config, LanguageConfig):
        model, inputs = Llama(ModelConfig(language=config)), ((1, 1, config.width), (1, 1), (1, 1, 1))
    else:
        model = VisionTower(ModelConfig(vision=config))
        inputs = ((1, config.image_size, config.image_size, 3), (1, 0, config.width), (1, 0))
    first, *rest = inputs
    arrays = jnp.zeros(first), *(jnp.zeros(shape, int) for shape in rest)
    return jax.eval_shape(model.init, jax.random.key(0), *arrays)["params"]


def summarize(keys: Iterable[str]) -> str:
    """Keys in one line, those that differ by the layer only told once."""
    groups: dict[str, list[str]] = defaultdict(list)
    for key in sorted(keys):
        groups[re.sub(r"\.\d+\.", ".*.", key)].append(key)
    return ", ".join(same[0] if len(same) == 1 else f"{name} ({len(same)})" for name, same in groups.items())


def _find_prefix(tensors: Mapping[str, StoredTensor], name: str, folder: Path) -> str:
    """What the checkpoint puts in front of its names, told from a name that only this kind of tower has."""
    found = [key.removesuffix(name) for key in tensors if key == name or key.endswith("." + name)]
    if len(found) != 1:
        what = "none does" if not found else f"these do: {', '.join(prefix + name for prefix in found)}"
        raise WeightsError(
            f"{folder}: wrong architecture: expected one of its {len(tensors)} tensors to be named [...]{name}, {what}"
        )
    return found[0]


def _assign(
    config: LanguageConfig | VisionConfig,
    names: Mapping[str, str],
    tensors: Mapping[str, StoredTensor],
    prefix: str,
    droppable: tuple[str, ...],
) -> Tower:
    """The tower of ``config`` from ``names`` (theirs for each of ours). Every tensor that it needs is checked."""
    flat: dict[str, Any] = traverse_util.flatten_dict(tower_shapes(config), sep="/")
    places: dict[str, tuple[str, int | None]] = {}
    for ours, leaf in flat.items():
        if ours.startswith("layers/"):
            places |= {names[ours].format(layer): (ours, layer) for layer in range(leaf.shape[0])}
        else:
            places[names[ours]] = (ours, None)

    missing = [key for key in places if key not in tensors]
    unused = tuple(key for key in tensors if key not in places)
    strange = [key for key in unused if key.startswith(prefix) and not key.endswith(BUFFERS + droppable)]
    if missing or strange:
        folder = next(iter(tensors.values())).file.parent
        problems = [
            f"{label} {summarize(keys)}"
            for label, keys in (("missing:", missing), ("no place in this architecture for:", strange))
            if keys
        ]
        raise WeightsError(f"{folder}: its tensors do not fit its config.json: {'; '.join(problems)}")

    pieces = []
    for key, (ours, layer) in places.items():
        tensor, shape = tensors[key], flat[ours].shape if layer is None else flat[ours].shape[1:]
        axes = AXES.get(ours.rsplit("/", 1)[-1], tuple(range(len(shape))))
        expected = tuple(shape[axes.index(axis)] for axis in range(len(shape)))
        if tensor.shape != expected:
            raise WeightsError(f"{tensor.file}: {key}: expected shape {expected} by config.json, found {tensor.shape}")
        tensor.check()
        pieces.append(Piece(ours, layer, tensor, axes))
    return Tower(config, {path: leaf.shape for path, leaf in flat.items()}, tuple(pieces), {}, unused)
