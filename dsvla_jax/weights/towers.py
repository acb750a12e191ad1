"""The parameters of a tower, and the stored tensors that they are read from, whatever the format."""

import dataclasses
import math
import re
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping
from pathlib import Path
from types import EllipsisType
from typing import Generic, Protocol, TypeVar, cast

import jax
import jax.numpy as jnp
import numpy as np
from flax import traverse_util
from numpy.typing import DTypeLike
from tqdm import tqdm

from dsvla_jax.checkpoints.storage import PyTree
from dsvla_jax.model.clip import VisionTower
from dsvla_jax.model.config import LanguageConfig, LoraConfig, ModelConfig, VisionConfig, VisualPromptConfig
from dsvla_jax.model.llama import Llama
from dsvla_jax.weights.positions import resample_positions
from dsvla_jax.weights.stored_tensors import StoredTensor, WeightsError

# The path of a parameter, and which layer of it where layers are stacked.
Place = tuple[str, int | None]

# Which of the stored axes becomes each of ours: (out, in) -> (in, out), (out, in, y, x) -> (y, x, in, out).
AXES = {
    **dict.fromkeys(("kernel", "output", "projection", "a", "b"), (1, 0)),
    "patch_kernel": (2, 3, 1, 0),
}

# The first part of the path of parameters whose leading axis counts layers.
STACKED = ("layers", "visual_blocks", "adapter_query", "gate")

# Rows of a stored tensor that are in memory at a time; as many make a chunk of the folder that is written.
ROWS = 2048


TowerConfig = LanguageConfig | VisionConfig | VisualPromptConfig | LoraConfig
"""Sizes of what a checkpoint holds."""
C = TypeVar("C", bound=TowerConfig)


class Writable(Protocol):
    """An array in memory or on disk that takes values at an index."""

    def __setitem__(self, index: tuple[int | slice, ...] | EllipsisType, values: np.ndarray, /) -> None: ...


@dataclasses.dataclass(frozen=True)
class Piece:
    """A stored tensor, and where it goes. axes: which of the stored axes becomes each of ours."""

    place: Place
    tensor: StoredTensor
    axes: tuple[int, ...]

    def copy_to(self, array: Writable, dtype: DTypeLike) -> None:
        """Writes the tensor, some rows at a time, to the parameter's array (NumPy or on disk) of ``dtype``."""
        axis, layer = self.axes.index(0), self.place[1]
        head_dim = self.tensor.head_dim or 1
        step = max(ROWS // head_dim, 1) * head_dim
        for start in range(0, self.tensor.shape[0], step):
            rows = self.tensor.read(start, min(start + step, self.tensor.shape[0]))
            index: list[slice] = [slice(None)] * len(self.axes)
            index[axis] = slice(start, start + len(rows))
            array[tuple(index) if layer is None else (layer, *index)] = rows.transpose(self.axes).astype(dtype)


@dataclasses.dataclass(frozen=True)
class Tower(Generic[C]):
    """Parameters whose tensors are all there, and not read yet.

    config: sizes, for the vision tower and the language model. shapes: by path, layers stacked. computed: parameters
    that are not as they are stored, float32. unused: keys of the checkpoint left alone. notes: what the tensors say
    otherwise than the checkpoint's config, and what is done about it.
    """

    config: C
    shapes: Mapping[str, tuple[int, ...]]
    pieces: tuple[Piece, ...]
    unused: tuple[str, ...]
    notes: tuple[str, ...] = ()
    computed: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict)

    @property
    def size(self) -> int:
        """How many numbers it has."""
        return sum(math.prod(shape) for shape in self.shapes.values())

    def copy_to(self, arrays: Mapping[str, Writable], dtype: DTypeLike) -> None:
        """Fills the arrays (NumPy or on disk) of its parameters; few rows of one tensor are in memory at a time."""
        for path, values in self.computed.items():
            arrays[path][...] = values.astype(dtype)
        pieces = [piece for piece in self.pieces if piece.place[0] not in self.computed]
        size = sum(math.prod(piece.tensor.shape) for piece in pieces)
        with tqdm(total=size, desc="import", unit="number", unit_scale=True, disable=None) as bar:
            for piece in pieces:
                piece.copy_to(arrays[piece.place[0]], dtype)
                bar.update(math.prod(piece.tensor.shape))

    def replaced(
        self, config: LanguageConfig, tensors: Mapping[Place, StoredTensor], source: Path
    ) -> "Tower[LanguageConfig]":
        """The tower of ``config`` with some of its tensors from another file. Raises WeightsError as `assign` does."""
        shapes = tower_shapes(config)
        own = {piece.place: piece for piece in self.pieces}
        missing = [place for place in _places(shapes) if place not in own and place not in tensors]
        if missing:
            raise WeightsError(f"{source}: missing: {summarize(f'{path} of layer {layer}' for path, layer in missing)}")
        pieces = tuple(
            _piece(place, tensors[place], shapes, AXES) if place in tensors else own[place] for place in _places(shapes)
        )
        return Tower(config, shapes, pieces, self.unused, self.notes, self.computed)

    def require_equal(self, tensors: Mapping[Place, StoredTensor], source: Path) -> None:
        """Raises WeightsError where another file's tensors are not those at the same places, but for their rounding."""
        for piece in self.pieces:
            other = tensors.get(piece.place)
            if piece.place[0] in self.computed or other is None:
                continue
            if not piece.tensor.equals(other, rounded=True):
                raise WeightsError(
                    f"{source}: {other.key}: not the {piece.tensor.key} of {piece.tensor.file}: it was trained with "
                    "another model, or trained that one's weights too; name as the source the model that it belongs to"
                )

    def load(self, dtype: DTypeLike = np.float32) -> dict[str, PyTree]:
        """Its parameters in memory, a nested dict."""
        arrays = {path: np.empty(shape, dtype) for path, shape in self.shapes.items()}
        self.copy_to(arrays, dtype)
        return traverse_util.unflatten_dict(arrays, sep="/")


def assign(
    config: C,
    shapes: Mapping[str, tuple[int, ...]],
    names: Mapping[str, str],
    tensors: Mapping[str, StoredTensor],
    source: Path,
    *,
    prefix: str | tuple[str, ...] = "",
    droppable: Collection[str] = (),
    notes: tuple[str, ...] = (),
    axes: Mapping[str, tuple[int, ...]] = AXES,
) -> Tower[C]:
    """The tower of ``config`` with parameters of ``shapes``. Every tensor is checked, and none is read.

    names: the checkpoint's name of each parameter, with {} where the number of the layer stands. prefix: what the names
    of this tower's tensors begin with (any one of several); one that has no place is an error, unless ``droppable`` has
    its name. notes: the tower's. axes: which of the stored axes becomes each of ours, by the last part of a path, where
    that is another one.
    Raises WeightsError naming files and keys.
    """
    if (layers := max(shape[0] for path, shape in shapes.items() if path.split("/")[0] in STACKED)) > len(tensors):
        raise WeightsError(f"{source}: {len(tensors)} tensors cannot be the {layers} layers that its config says")
    keys = {place: names[place[0]].format(place[1]) for place in _places(shapes)}
    used = set(keys.values())
    missing = [key for key in used if key not in tensors]
    unused = tuple(key for key in tensors if key not in used)
    strange = [key for key in unused if key.startswith(prefix) and key not in droppable]
    if missing or strange:
        problems = [
            f"{label} {summarize(found)}"
            for label, found in (("missing:", missing), ("no place in this architecture for:", strange))
            if found
        ]
        raise WeightsError(f"{source}: its tensors do not fit its sizes: {'; '.join(problems)}")
    pieces = tuple(_piece(place, tensors[key], shapes, axes) for place, key in keys.items())
    return Tower(config, shapes, pieces, unused, notes)


def find_places(
    names: Mapping[str, str], shapes: Mapping[str, tuple[int, ...]], tensors: Mapping[str, StoredTensor]
) -> dict[Place, StoredTensor]:
    """Those of the tensors that are parameters of ``shapes`` by their names (see `assign`)."""
    keys = {place: names[place[0]].format(place[1]) for place in _places(shapes) if place[0] in names}
    return {place: tensors[key] for place, key in keys.items() if key in tensors}


def _places(shapes: Mapping[str, tuple[int, ...]]) -> Iterator[Place]:
    for path, shape in shapes.items():
        for layer in range(shape[0]) if path.split("/")[0] in STACKED else (None,):
            yield path, layer


def _piece(
    place: Place, tensor: StoredTensor, shapes: Mapping[str, tuple[int, ...]], axes: Mapping[str, tuple[int, ...]]
) -> Piece:
    shape = shapes[place[0]] if place[1] is None else shapes[place[0]][1:]
    order = axes.get(place[0].rsplit("/", 1)[-1], tuple(range(len(shape))))
    expected = tuple(shape[order.index(axis)] for axis in range(len(shape)))
    if tensor.shape != expected:
        raise WeightsError(f"{tensor.file}: {tensor.key}: expected shape {expected} by its sizes, found {tensor.shape}")
    tensor.check()
    return Piece(place, tensor, order)


def resample(tower: Tower[VisionConfig], image_size: int, source: Path) -> Tower[VisionConfig]:
    """The vision tower for images of another size. Raises WeightsError where it has no such size."""
    try:
        config = dataclasses.replace(tower.config, image_size=image_size)
    except ValueError as error:
        raise WeightsError(f"image size {image_size} does not suit the tower in {source}: {error}") from error
    name = "positional_embedding"
    stored = next(piece.tensor for piece in tower.pieces if piece.place[0] == name)
    positions = resample_positions(stored.read().astype(np.float32), config.grid)
    return dataclasses.replace(
        tower, config=config, shapes={**tower.shapes, name: positions.shape}, computed={name: positions}
    )


def tower_shapes(config: LanguageConfig | VisionConfig) -> dict[str, tuple[int, ...]]:
    """The shapes of a tower's parameters by path."""
    if isinstance(config, LanguageConfig):
        model, inputs = Llama(ModelConfig(language=config)), ((1, 1, config.width), (1, 1), (1, 1, 1))
    else:
        model = VisionTower(ModelConfig(vision=config))
        inputs = ((1, 1, config.image_size, config.image_size, 3), (1, 0, config.width), (1, 0))
    first, *rest = inputs
    arrays = jax.ShapeDtypeStruct(first, jnp.float32), *(jax.ShapeDtypeStruct(shape, jnp.int32) for shape in rest)
    return flat_shapes(jax.eval_shape(model.init, jax.random.key(0), *arrays)["params"])


def flat_shapes(tree: PyTree) -> dict[str, tuple[int, ...]]:
    """The shapes of a nested dict's leaves by path."""
    flat = cast(dict[str, jax.Array], traverse_util.flatten_dict(tree, sep="/"))
    return {path: leaf.shape for path, leaf in flat.items()}


def summarize(keys: Iterable[str]) -> str:
    """Keys in one line; those that differ by the layer only are one entry."""
    groups: dict[str, list[str]] = defaultdict(list)
    for key in sorted(keys):
        groups[re.sub(r"\.\d+\.", ".*.", key)].append(key)
    return ", ".join(same[0] if len(same) == 1 else f"{name} ({len(same)})" for name, same in groups.items())


def find_prefix(tensors: Iterable[str], name: str, source: Path) -> str:
    """What a checkpoint puts in front of its names, by a name that only this kind of tower has."""
    names = list(tensors)
    found = [key.removesuffix(name) for key in names if key == name or key.endswith("." + name)]
    if len(found) != 1:
        what = "none does" if not found else f"these do: {', '.join(prefix + name for prefix in found)}"
        raise WeightsError(
            f"{source}: wrong architecture: expected one of its {len(names)} tensors to be named [...]{name}, {what}"
        )
    return found[0]
