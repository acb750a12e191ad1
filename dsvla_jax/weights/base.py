"""Imported backbones on disk: what a Hugging Face checkpoint becomes once, and a model starts from many times."""

import dataclasses
from pathlib import Path
from typing import Any

import cattrs
import numpy as np

from dsvla_jax.checkpoints import CheckpointError, describe_weights, restore_weights, save_weights
from dsvla_jax.model.config import LanguageConfig, VisionConfig
from dsvla_jax.weights.safetensors import WeightsError
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
    """Reads the towers of Hugging Face folders and writes them to ``out``, a new folder, whole or not at all.

    image_size, projection: see `read_vision`. dtype: of what is kept on disk. Returns what was read, by tower.
    Raises WeightsError where a source does not fit, CheckpointError where ``out`` exists.
    """
    if out.exists():  # told before minutes of reading
        raise CheckpointError(f"{out} exists already; remove it, or choose another folder")
    if vision_source is None and (image_size is not None or projection):
        raise WeightsError("image size and projection are the vision tower's: name the folder that has one (--vision)")
    towers = {"language": read_language(source, dtype)}
    if vision_source is not None:
        towers["vision"] = read_vision(vision_source, image_size, dtype, projection)
    sizes = Towers(**{"vision": None} | {name: tower.config for name, tower in towers.items()})  # pyright: ignore
    save_weights(out, {name: tower.params for name, tower in towers.items()}, dataclasses.asdict(sizes))
    return towers


def read_towers(folder: Path) -> Towers:
    """What `import_backbones` wrote to a folder. Raises CheckpointError where it did not."""
    try:
        return _converter.structure(describe_weights(folder), Towers)
    except cattrs.BaseValidationError as error:
        details = "; ".join(cattrs.transform_error(error))
        raise CheckpointError(f"{folder}: not weights of this version: {details}; import them again") from error


def load_backbones(folder: Path) -> dict[str, Any]:
    """The params of the towers in a folder, float32, by tower: they replace those of a model of `read_towers`' sizes.

    Raises CheckpointError where the folder does not hold them.
    """
    towers = read_towers(folder)
    like = {"language": tower_shapes(towers.language)}
    if towers.vision is not None:
        like["vision"] = tower_shapes(towers.vision)
    return restore_weights(folder, like)
