"""A trained run in the formats of the rest of the field: PEFT adapters, or Hugging Face models with them merged.

Each tower is a folder of its own, since PEFT adapts one model, and transformers opens one:

    OUT/language/   adapters: adapter_config.json, adapter_model.safetensors (for LlamaForCausalLM)
                    merged: config.json, model*.safetensors, tokenizer.json, tokenizer_config.json
    OUT/vision/     the same for CLIPVisionModel, or CLIPVisionModelWithProjection where the tower has the projection
    OUT/projector/  model.safetensors: the projection module, which no other format knows, by its paths in
                    `dsvla_jax.model` (joined by dots) and in their layout, kernels (in, out); with several
                    cameras, the vision tower's camera_embedding too
    OUT/policy.json the run's own, with every size and the encoding
"""

import dataclasses
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path

import jax
import numpy as np
from flax import traverse_util
from numpy.typing import DTypeLike
from tqdm import tqdm

from dsvla_jax.checkpoints.run import RunCheckpoints
from dsvla_jax.checkpoints.storage import require_same_shapes
from dsvla_jax.encoding.text import Tokenizer
from dsvla_jax.errors import UserError
from dsvla_jax.model.config import LoraConfig, ModelConfig
from dsvla_jax.model.lora import merge_lora, require_mergeable
from dsvla_jax.model.variables import CAMERA_EMBEDDING, PROJECTOR
from dsvla_jax.model.vla import initialize
from dsvla_jax.weights.imported_folder import new_folder
from dsvla_jax.weights.readers.hugging_face import CLIP_NAMES, LLAMA_NAMES, LM_HEAD, VISUAL_PROJECTION
from dsvla_jax.weights.towers import AXES
from dsvla_jax.weights.writers.hugging_face import (
    language_json,
    vision_json,
    write_json,
    write_tensors,
    write_tokenizer,
)
from dsvla_jax.weights.writers.peft import Variables, write_adapters

TOWERS = ("language", "vision")


@dataclasses.dataclass(frozen=True)
class ExportOptions:
    """How a run is written.

    merged: whole models with the adapters added to their weights; otherwise the adapters alone.
    dtype: of the numbers on disk. Merging is done in float32.
    shard_bytes: how large one file of a model may be.
    bases: by tower, the model that its adapters belong to, a folder or a name on the Hub, for peft's AutoPeftModel.
    """

    merged: bool = False
    dtype: DTypeLike = np.float32
    shard_bytes: float = 2e9
    bases: Mapping[str, str | None] = dataclasses.field(default_factory=dict)


def export_run(run: Path, out: Path, model: ModelConfig, tokenizer: Tokenizer, options: ExportOptions) -> list[str]:
    """Writes the newest checkpoint of a run to ``out``, a new folder, which appears whole or not at all.

    In memory are one variable (a kind of weight of all layers) and one file at a time. Returns the folders in it.
    Raises CheckpointError where ``out`` exists or the run has not ``model``'s sizes, UserError where there are no
    adapters to write, or where they cannot be merged.
    """
    if not options.shard_bytes > 0:  # NaN too
        raise UserError(f"size of a file: expected more than 0 GB, got {options.shard_bytes / 1e9:g}")
    if options.merged and any(options.bases.values()):
        raise UserError("a base is noted in adapters only: leave it out, or export without --merged")
    with new_folder(out) as folder:
        return _write_run(run, folder, model, tokenizer, options)


def _write_run(run: Path, folder: Path, model: ModelConfig, tokenizer: Tokenizer, options: ExportOptions) -> list[str]:
    checkpoints = RunCheckpoints(run, read_only=True)
    variables = checkpoints.list_variables()
    checkpoints.close()
    tree = traverse_util.unflatten_dict(variables)
    require_same_shapes(tree, jax.eval_shape(lambda: initialize(model, jax.random.key(0))), run)
    towers = [tower for tower in TOWERS if options.merged or tower in tree.get("lora", {})]
    if not towers:
        raise UserError(f"{run}: this run has no adapters: export its whole models with --merged")
    if options.merged:
        if model.base_dtype == "int8":
            raise UserError(f"{run}: its base is in 8 bits, no model to publish; export the adapters, without --merged")
        try:
            require_mergeable(tree)
        except ValueError as error:
            raise UserError(f"{run}: {error}; without --merged they are exported as they are") from error

    if foreign := [tower for tower, base in options.bases.items() if base and tower not in towers]:
        raise UserError(f"{run}: no adapters in its {' and '.join(foreign)} tower: leave out that tower's base")

    shutil.copy(run / "policy.json", folder)
    for tower in towers:
        names = _tensor_names(tower, model)
        parts = {p: leaf for p, leaf in variables.items() if p[1] == tower and p[-1] != CAMERA_EMBEDDING}
        (folder / tower).mkdir()
        if options.merged:
            _write_model(folder / tower, parts, names, model.lora, options)
            _describe_model(folder / tower, tower, model, tokenizer, np.dtype(options.dtype).name)
        else:
            write_adapters(folder / tower, tower, parts, names, model, options.dtype, options.bases.get(tower))
    (folder / PROJECTOR).mkdir()
    projection = {".".join(p[2:]): leaf for p, leaf in variables.items() if p[:2] == ("params", PROJECTOR)}
    projection |= {p[-1]: leaf for p, leaf in variables.items() if p[-1] == CAMERA_EMBEDDING}
    sizes = {name: leaf.size * np.dtype(options.dtype).itemsize for name, leaf in projection.items()}
    arrays = ((name, leaf.read().astype(options.dtype)) for name, leaf in projection.items())
    write_tensors(folder / PROJECTOR, sizes, arrays, options.shard_bytes)
    return [*towers, PROJECTOR]


def _tensor_names(tower: str, model: ModelConfig) -> dict[str, str]:
    """Their name for each of our variables of a tower, with {} for the layer."""
    if tower == "language":
        return {ours: f"model.{theirs}" for ours, theirs in LLAMA_NAMES.items()} | {"output": LM_HEAD}
    return {ours: f"vision_model.{theirs}" for ours, theirs in CLIP_NAMES.items()} | {"projection": VISUAL_PROJECTION}


def _write_model(
    folder: Path, parts: Variables, names: Mapping[str, str], lora: LoraConfig | None, options: ExportOptions
) -> None:
    """The base weights of a tower, with what adapters there are added."""
    params = {"/".join(path[2:]): leaf for path, leaf in parts.items() if path[0] == "params"}
    adapters = {path[3]: leaf for path, leaf in parts.items() if path[0] == "lora" and path[-1] == "a"}
    sizes = {}
    for ours, leaf in params.items():
        layers = range(leaf.shape[0]) if ours.startswith("layers/") else (0,)
        size = leaf.size // len(layers) * np.dtype(options.dtype).itemsize
        sizes |= {names[ours].format(layer): size for layer in layers}

    def tensors() -> Iterator[tuple[str, np.ndarray]]:
        for ours, leaf in tqdm(params.items(), desc=f"export {folder.name}", unit="weight", disable=None):
            values, axes = leaf.read(), AXES.get(ours.rsplit("/", 1)[-1])
            pair = None
            if ours.endswith("/kernel") and ours.split("/")[1] in adapters:
                pair = {name: parts[("lora", leaf.path[1], *leaf.path[2:-1], name)].read() for name in "ab"}
            for layer in range(len(values)) if ours.startswith("layers/") else (None,):
                value = values if layer is None else values[layer]
                if pair is not None:
                    assert lora is not None
                    one = {"params": {"kernel": value}, "lora": {name: array[layer] for name, array in pair.items()}}
                    value = np.asarray(merge_lora(one, lora)["params"]["kernel"])
                value = value if axes is None else value.transpose(np.argsort(axes))
                yield names[ours].format(layer), np.ascontiguousarray(value, options.dtype)

    write_tensors(folder, sizes, tensors(), options.shard_bytes)


def _describe_model(folder: Path, tower: str, model: ModelConfig, tokenizer: Tokenizer, dtype: str) -> None:
    if tower == "vision":
        write_json(folder / "config.json", vision_json(model.vision, dtype))
    else:
        special = write_tokenizer(folder, tokenizer)
        write_json(folder / "config.json", language_json(model.language, dtype) | special)
