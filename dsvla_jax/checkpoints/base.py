"""The frozen variables of a run: written once, and read by every program that needs the whole model."""

from pathlib import Path

import jax
import orbax.checkpoint as ocp

from dsvla_jax.checkpoints.digests import FILE as DIGESTS
from dsvla_jax.checkpoints.digests import damage, write_digests
from dsvla_jax.checkpoints.storage import (
    CheckpointError,
    PyTree,
    abstract,
    require_index,
    require_same_shapes,
)


def save_base(folder: Path, frozen: PyTree) -> None:
    """Writes the frozen variables, if there are any and they are not there yet, and the digests of their files."""
    # Without its digests a base is one whose writing was cut short.
    if jax.tree.leaves(frozen) and not (folder / DIGESTS).exists():
        with ocp.StandardCheckpointer() as checkpointer:
            checkpointer.save(folder, frozen, force=True)
        if jax.process_index() == 0:
            require_index(folder)
            write_digests(folder, top=True)


def restore_base(folder: Path, like: PyTree) -> PyTree:
    """Reads the frozen variables, with the structure, shapes and shardings of `like`.

    Raises CheckpointError if they are missing, damaged, or of another model.
    """
    if not jax.tree.leaves(like):
        return like
    if not folder.exists():
        raise CheckpointError(f"{folder}: the frozen base of this run is missing; train the run again")
    if jax.process_index() == 0 and (problem := damage(folder)):
        raise CheckpointError(
            f"{folder} is damaged: {problem}; put back a copy of the folder, or train again with another --run"
        )
    with ocp.StandardCheckpointer() as checkpointer:
        require_same_shapes(checkpointer.metadata(folder).item_metadata, like, folder)
        return checkpointer.restore(folder, abstract(like))
