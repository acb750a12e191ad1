"""The variables of a run, one at a time: on disk until they are read."""

import dataclasses
import math
from collections.abc import Iterable
from pathlib import Path
from typing import cast

import jax
import numpy as np
import orbax.checkpoint as ocp
from flax import traverse_util

from dsvla_jax.checkpoints.storage import PyTree, tree_of


@dataclasses.dataclass(frozen=True)
class StoredVariable:
    """One variable of a run: on disk until it is read."""

    folder: Path
    path: tuple[str, ...]
    shape: tuple[int, ...]

    @property
    def size(self) -> int:
        """How many numbers."""
        return math.prod(self.shape)

    def read(self) -> np.ndarray:
        """The variable as it is stored; no other is loaded."""
        item = traverse_util.unflatten_dict({self.path: jax.ShapeDtypeStruct(self.shape, np.float32)})
        how = traverse_util.unflatten_dict({self.path: ocp.RestoreArgs(restore_type=np.ndarray)})
        with ocp.PyTreeCheckpointer() as checkpointer:
            args = ocp.args.PyTreeRestore(item=item, restore_args=how, partial_restore=True)
            restored = traverse_util.flatten_dict(checkpointer.restore(self.folder, args=args))
            return np.asarray(restored[self.path])


def stored_variables(items: Iterable[tuple[Path, PyTree]]) -> dict[tuple[str, ...], StoredVariable]:
    """Returns every variable of folders by its path. items: folder, and orbax's metadata of what it holds."""
    return {
        path: StoredVariable(folder, path, tuple(leaf.shape))
        for folder, metadata in items
        for path, leaf in cast(dict[tuple[str, ...], jax.Array], traverse_util.flatten_dict(tree_of(metadata))).items()
    }
