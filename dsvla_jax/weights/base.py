"""Imported backbones on disk: what a Hugging Face checkpoint becomes once, and a model starts from many times."""

import dataclasses
from pathlib import Path
from typing import Any

import cattrs
import jax
import numpy as np

from dsvla_jax.checkpoints import CheckpointError
from dsvla_jax.model.config import LanguageConfig, VisionConfig
from dsvla_jax.weights.folder import create_weights, describe_weights, restore_weights
from dsvla_jax.weights.tensors import WeightsError
from dsvla_jax.weights.towers import Tower, read_language, read_vision, tower_shapes


@dataclasses.dataclass(frozen=True)
class Towers:
    """The sizes of the towers that an imported folder holds; vision is None where none was imported."""

    language: LanguageConfig
    vision: VisionConfig | None


_converter = cattrs.Converter(forbid_extra_keys=True)


def import_backbones(
    source: Path,
    out: Path,
    vision_source: Path | None = None,
    image_size: int | None = None,
    dtype: Any = np.float32,
    projection: bool = False,
) -> dict[str, Tower]:
    """Writes the towers of Hugging Face folders to ``out``, a new folder, whole or not at all.

    In memory are few rows of a tensor at a time. image_size, projection: see `read_vision`. dtype: of what is kept on
    disk. Returns what was written, by tower.
    Raises WeightsError where a source does not fit, CheckpointError where ``out`` exists.
    """
    if vision_source is None and (image_size is not None or projection):
        raise WeightsError("image size and projection are the vision tower's: name the folder that has one (--vision)")
    towers = {"language": read_language(source)}
    if vision_source is not None:
        towers["vision"] = read_vision(vision_source, image_size, projection)
    sizes = Towers(**{"vision": None} | {name: tower.config for name, tower in towers.items()})  # pyright: ignore
    leaves = {
        f"{name}/{path}": jax.ShapeDtypeStruct(shape, dtype)
        for name, tower in towers.items()
        for path, shape in tower.shapes.items()
    }
    with create_weights(out, leaves, "/layers/", dataclasses.asdict(sizes)) as arrays:
        for name, tower in towers.items():
            tower.copy_to({path: arrays[f"{name}/{path}"] for path in tower.shapes}, dtype)
    return towers


def read_towers(folder: Path) -> Towers:
    """What `import_backbones` wrote to a folder. Raises CheckpointError where it did not."""
    try:
        return _converter.structure(describe_weights(folder), Towers)
    except cattrs.BaseValidationError as error:
        details = "; ".join(cattrs.transform_error(error))
        raise CheckpointError(f"{folder}: not weights of this version: {details}; import them again") from error


def backbone_shapes(folder: Path) -> dict[str, Any]:
    """The params of the towers in a folder, by tower, as float32 ShapeDtypeStructs."""
    towers = read_towers(folder)
    shapes = {"language": tower_shapes(towers.language)}
    if towers.vision is not None:
        shapes["vision"] = tower_shapes(towers.vision)
    return shapes


def load_backbones(folder: Path, like: Any = None) -> dict[str, Any]:
    """The params of the towers in a folder, by tower: they replace those of a model of `read_towers`' sizes.

    like: what `backbone_shapes` gives, with the dtypes and shardings that are wanted; None for float32 on one device.
    Raises CheckpointError where the folder does not hold them.
    """
    return restore_weights(folder, backbone_shapes(folder) if like is None else like)
