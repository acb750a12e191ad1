"""Imported backbones on disk: what checkpoints of other projects become once, and models start from many times."""

import dataclasses
from functools import partial
from pathlib import Path

import cattrs
import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding
from jax.tree_util import KeyPath, keystr
from numpy.typing import DTypeLike

from dsvla_jax.checkpoints.storage import CheckpointError, PyTree, require_same_shapes
from dsvla_jax.model.config import LanguageConfig, LoraConfig, ModelConfig, VisionConfig, VisualPromptConfig
from dsvla_jax.model.partition import shardings
from dsvla_jax.model.quantize import SCALE, TOWERS, is_quantized, quantize_kernel
from dsvla_jax.model.variables import MATRICES
from dsvla_jax.model.vla import initialize
from dsvla_jax.policy import load_policy_config
from dsvla_jax.weights.imported_folder import DESCRIPTION, create_weights, describe_weights, restore_weights
from dsvla_jax.weights.readers.any_format import read_language, read_vision
from dsvla_jax.weights.readers.llama_adapter import read_adapter
from dsvla_jax.weights.stored_tensors import WeightsError
from dsvla_jax.weights.towers import Tower

# Where each tower's parameters are among a model's variables.
VARIABLES = {
    "language": "params/language",
    "vision": "params/vision",
    "projector": "params/projector",
    "lora": "lora/language",
}
# What the sizes of a tower are called in a ModelConfig, where that is another name.
NAMES_IN_MODEL = {"projector": "visual_prompt"}
# Pixels along a side; positional embeddings of more would fill the memory.
LARGEST_IMAGE = 4096
# What is trained further is not rounded.
TRAINED = ("projector", "lora")


@dataclasses.dataclass(frozen=True)
class Towers:
    """The sizes of what an imported folder holds; None for what was not imported."""

    language: LanguageConfig
    vision: VisionConfig | None = None
    projector: VisualPromptConfig | None = None
    lora: LoraConfig | None = None


_converter = cattrs.Converter(forbid_extra_keys=True)


def import_backbones(
    source: Path,
    out: Path,
    vision_source: Path | None = None,
    image_size: int | None = None,
    dtype: DTypeLike = np.float32,
    projection: bool = False,
    adapter: Path | None = None,
    adapter_heads: int = VisualPromptConfig().heads,
) -> dict[str, Tower]:
    """Writes the towers of checkpoints to ``out``, a new folder, whole or not at all.

    In memory are few rows of a tensor at a time. source, vision_source: see `read_language` and `read_vision`, there
    also image_size and projection. dtype: of the towers on disk. adapter: a file of LLaMA-Adapter's projection, gates
    and adapters for these towers (`read_adapter`); adapter_heads: of its visual blocks. Returns what was written.
    Raises WeightsError where a source does not fit, CheckpointError where ``out`` exists.
    """
    if vision_source is None and (image_size is not None or projection or adapter is not None):
        raise WeightsError(
            "image size, projection and adapter need a vision tower: name the source that has one (--vision)"
        )
    if image_size is not None and not 0 < image_size <= LARGEST_IMAGE:
        raise WeightsError(f"image size: expected 1 to {LARGEST_IMAGE} pixels, got {image_size}")
    if adapter_heads < 1:
        raise WeightsError(f"heads of the adapter's visual blocks: expected at least 1, got {adapter_heads}")
    if adapter is None and adapter_heads != VisualPromptConfig().heads:
        raise WeightsError("heads of the adapter's visual blocks need an adapter: name its file (--adapter)")
    towers: dict[str, Tower] = {"language": read_language(source)}
    if vision_source is not None:
        towers["vision"] = read_vision(vision_source, image_size, projection or adapter is not None)
    if adapter is not None:
        added = read_adapter(adapter, towers["language"].config, towers["vision"].config, adapter_heads)
        for name, tensors in added.repeated.items():
            towers[name].require_equal(tensors, adapter)
        towers["language"] = towers["language"].replaced(added.language, added.instead, adapter)
        towers["projector"] = added.projector
        towers |= {} if added.lora is None else {"lora": added.lora}
    sizes = Towers(**{name: tower.config for name, tower in towers.items()})
    leaves = {
        f"{VARIABLES[name]}/{path}": jax.ShapeDtypeStruct(shape, np.float32 if name in TRAINED else dtype)
        for name, tower in towers.items()
        for path, shape in tower.shapes.items()
    }
    with create_weights(out, leaves, dataclasses.asdict(sizes)) as arrays:
        for name, tower in towers.items():
            own = {path: f"{VARIABLES[name]}/{path}" for path in tower.shapes}
            tower.copy_to({path: arrays[full] for path, full in own.items()}, leaves[next(iter(own.values()))].dtype)
    return towers


def read_towers(folder: Path) -> Towers:
    """What `import_backbones` wrote to a folder. Raises CheckpointError where it did not."""
    try:
        return _converter.structure(describe_weights(folder), Towers)
    except cattrs.BaseValidationError as error:
        details = "; ".join(cattrs.transform_error(error))
        raise CheckpointError(f"{folder}: not weights of this version: {details}; import them again") from error


def present_towers(towers: Towers) -> list[str]:
    """The names of those that have params in the folder."""
    return [name for name in ("language", "vision", "projector") if getattr(towers, name) is not None]


def backbone_shapes(folder: Path) -> dict[str, PyTree]:
    """The variables in a folder, {"params": by tower, and "lora" if there are any}, as float32 ShapeDtypeStructs."""
    towers = read_towers(folder)
    config = ModelConfig(
        vision=towers.vision or VisionConfig(),
        language=towers.language,
        fusion="prefix" if towers.projector is None else "adapter",
        visual_prompt=towers.projector or VisualPromptConfig(),
        lora=towers.lora,
    )
    variables = jax.eval_shape(lambda: initialize(config, jax.random.key(0)))
    shapes = {"params": {name: variables["params"][name] for name in present_towers(towers)}}
    return shapes if towers.lora is None else {**shapes, "lora": variables["lora"]}


def load_backbones(folder: Path, like: PyTree = None) -> dict[str, PyTree]:
    """The variables in a folder: they replace those of a model of `read_towers`' sizes.

    like: what `backbone_shapes` gives, with the dtypes and shardings that are wanted; None for float32 on one device.
    Raises CheckpointError where the folder does not hold them.
    """
    return restore_weights(folder, backbone_shapes(folder) if like is None else like)


def is_imported(folder: Path) -> bool:
    """Whether a folder is one that `import_backbones` wrote."""
    return (folder / DESCRIPTION).is_file()


def require_same_model(folder: Path, model: ModelConfig) -> Towers:
    """What a folder holds. Raises CheckpointError, naming the fields that differ, if it is of another model."""
    towers = read_towers(folder)
    if problems := _differences(towers, model):
        raise CheckpointError(f"{folder}: weights of another model: {'; '.join(problems)}; change the config's values")
    return towers


def require_base(folder: Path, model: ModelConfig) -> None:
    """Raises CheckpointError where a run or a folder of imported weights is missing, or is of another model."""
    if is_imported(folder):
        require_same_model(folder, model)
        return
    policy = load_policy_config(folder)
    if policy.baseline is not None:
        raise CheckpointError(
            f"{folder}: a policy of {policy.baseline.kind}; expected a run of 3DS-VLA, or a folder of imported weights"
        )
    base = policy.model
    found, expected = (
        jax.eval_shape(partial(initialize, config), jax.random.key(0))["params"]
        for config in (base, with_cameras_of(model, base.cameras))
    )
    require_same_shapes(found, expected, folder)


def with_cameras_of(model: ModelConfig, cameras: int) -> ModelConfig:
    """The model as a base that reads so many cameras has it: one of a single camera serves models of any number."""
    return dataclasses.replace(model, cameras=1) if cameras == 1 else model


def load_for_model(folder: Path, model: ModelConfig, mesh: Mesh, frozen: bool) -> dict[str, PyTree]:
    """The variables in a folder for a model of these sizes, split over the mesh.

    frozen: whether the towers will not learn, so that their matrices have the dtype of a frozen base.
    What the folder does not hold is not there: it stays as the model initialises it. Kernels that the model keeps in 8
    bits are converted one after the other. Raises CheckpointError naming the fields of the config that differ.
    """
    towers = require_same_model(folder, model)
    full = dataclasses.replace(with_cameras_of(model, 1), base_dtype="same")
    variables = jax.eval_shape(lambda: initialize(full, jax.random.key(0)))
    like: dict[str, PyTree] = {"params": {name: variables["params"][name] for name in present_towers(towers)}}
    if towers.lora is not None:
        like["lora"] = {"language": variables["lora"]["language"]}
    where = shardings(like, mesh)

    def placed(path: KeyPath, leaf: jax.ShapeDtypeStruct, sharding: NamedSharding) -> jax.ShapeDtypeStruct:
        keys = keystr(path, simple=True, separator="/").split("/")
        narrow = keys[1] in TOWERS and keys[0] == "params" and keys[-1] in MATRICES
        dtype = model.frozen_dtype if narrow and frozen else leaf.dtype
        return jax.ShapeDtypeStruct(leaf.shape, dtype, sharding=sharding)

    def convert(path: str, array: jax.Array) -> dict[str, jax.Array]:
        _, *keys = path.split("/")
        if model.base_dtype != "int8" or not is_quantized(tuple(keys)):
            return {path: array}
        kernel, scale = jax.jit(quantize_kernel)(array)
        return {path: kernel, f"{path.rsplit('/', 1)[0]}/{SCALE}": scale}

    return restore_weights(folder, jax.tree_util.tree_map_with_path(placed, like, where), convert)


def _differences(towers: Towers, model: ModelConfig) -> list[str]:
    """Each field of the model's config whose value is another one in the folder."""
    pairs = {"language": model.language, "vision": model.vision}
    if towers.projector is not None:
        if model.fusion != "adapter":
            return [f"model.fusion: the config says {model.fusion!r}, its projection is of 'adapter'"]
        pairs["projector"] = model.visual_prompt
    if towers.lora is not None:
        if model.lora is None or "language" not in model.lora.towers:
            return ["model.lora: the config has no adapters in the language model, the folder has"]
        pairs["lora"] = dataclasses.replace(model.lora, towers=towers.lora.towers, init=towers.lora.init)
    return [
        f"model.{NAMES_IN_MODEL.get(name, name)}.{field}: the config says {value!r}, the folder {found!r}"
        for name, config in pairs.items()
        if (stored := getattr(towers, name)) is not None
        for field, value in vars(config).items()
        if value != (found := getattr(stored, field))
    ]
