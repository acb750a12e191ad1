"""What orbax and TensorStore ask of a path and of a tree, and the error that says what is wrong with a checkpoint."""

from pathlib import Path
from typing import Any, cast

import jax
import orbax.checkpoint as ocp
from flax import traverse_util

from dsvla_jax.errors import UserError

PyTree = Any  # no type of Python describes it
"""Nested containers of arrays, or of what has their shapes."""
ARRAY_INDEX = "manifest.ocdbt"

# Orbax looks for what it wrote with a pattern that begins with the folder's own path; TensorStore takes a backslash for
# a slash.
PATTERN_CHARACTERS, SEPARATOR = "[*?", "\\"


class CheckpointError(UserError):
    """A checkpoint is missing, damaged, cannot be written, or does not fit the model that asks for it."""


def require_writable_path(folder: Path, characters: str = PATTERN_CHARACTERS + SEPARATOR) -> None:
    """Raises CheckpointError if the absolute path has any of the characters: arrays written there could not be read."""
    if found := [character for character in characters if character in str(folder.absolute())]:
        raise CheckpointError(
            f"{folder.absolute()}: arrays cannot be stored in a folder whose path contains {' or '.join(found)}; "
            "choose another folder"
        )


def require_index(item: Path) -> None:
    """Raises CheckpointError if arrays were written without the index through which they are found."""
    if not (item / ARRAY_INDEX).is_file():
        raise CheckpointError(f"{item}: {ARRAY_INDEX} is missing, so its arrays could not be read")


def require_same_shapes(stored: PyTree, expected: PyTree, where: Path) -> None:
    """Raises CheckpointError naming the first parameters that a checkpoint lacks, or holds in another shape."""
    found, wanted = _shapes(tree_of(stored)), _shapes(expected)
    problems = [
        f"{name}: expected {wanted.get(name, 'nothing')}, found {found.get(name, 'nothing')}"
        for name in sorted(wanted.keys() | found.keys())
        if tuple(wanted.get(name, ())) != tuple(found.get(name, ())) or (name in wanted) != (name in found)
    ]
    if problems:
        more = f" (and {len(problems) - 3} more)" if len(problems) > 3 else ""
        raise CheckpointError(
            f"{where}: this checkpoint is of another model: {'; '.join(problems[:3])}{more}. "
            "Use the config that the run was trained with, or another --run folder"
        )


def _shapes(tree: PyTree) -> dict[str, tuple[int, ...]]:
    flat = cast(dict[tuple[str, ...], jax.Array], traverse_util.flatten_dict(tree))
    return {"/".join(map(str, path)): leaf.shape for path, leaf in flat.items()}


def tree_of(metadata: PyTree) -> PyTree:
    """The nested dict inside orbax's metadata of an item."""
    return getattr(metadata, "tree", metadata)


def abstract(tree: PyTree) -> PyTree:
    """What orbax is to restore: leaves without a sharding go to one device, whatever devices they were saved from."""
    # Orbax would otherwise look for the devices that saved them.
    here = jax.sharding.SingleDeviceSharding(jax.local_devices()[0])

    def struct_of(leaf: PyTree) -> PyTree:
        struct = ocp.utils.to_shape_dtype_struct(leaf)
        if isinstance(struct, jax.ShapeDtypeStruct) and struct.sharding is None:
            return struct.update(sharding=here)
        return struct

    return jax.tree.map(struct_of, tree)
