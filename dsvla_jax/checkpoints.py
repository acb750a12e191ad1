"""Saving and restoring pytrees: what training resumes from, and what a policy is loaded from.

A run folder holds

    checkpoints/<step>/   orbax: `trainable`, `optimizer`, and `iterator` (the position in the data, JSON)
    base/                 orbax: the frozen variables, written once; absent when everything is trained

Weights imported from elsewhere are a folder of their own (`dsvla_jax.weights.folder`).
"""

import dataclasses
import logging
import math
from pathlib import Path
from typing import Any

import jax
import numpy as np
import orbax.checkpoint as ocp
from flax import traverse_util

from dsvla_jax.errors import UserError


class CheckpointError(UserError):
    """A checkpoint is missing, damaged, or does not fit the model that asks for it."""


logging.getLogger("absl").setLevel(logging.WARNING)


@dataclasses.dataclass(frozen=True)
class Restored:
    """What a step of a run held. optimizer and iterator are None where they were not asked for."""

    step: int
    trainable: Any
    optimizer: Any = None
    iterator: Any = None


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
            restored: dict[tuple[str, ...], Any] = traverse_util.flatten_dict(
                checkpointer.restore(self.folder, args=args)
            )
            return restored[self.path]


class RunCheckpoints:
    """The checkpoints of one run folder; writes in the background, keeps the newest two."""

    def __init__(self, run: Path):
        self.folder = run.absolute() / "checkpoints"
        self._base = run.absolute() / "base"
        self._manager = ocp.CheckpointManager(
            self.folder,
            options=ocp.CheckpointManagerOptions(max_to_keep=2, enable_async_checkpointing=True),
            item_handlers={
                "trainable": ocp.StandardCheckpointHandler(),
                "optimizer": ocp.StandardCheckpointHandler(),
                "iterator": ocp.JsonCheckpointHandler(),
            },
        )

    @property
    def latest_step(self) -> int | None:
        """The newest complete step, or None."""
        return self._manager.latest_step()

    def save(self, step: int, trainable: Any, optimizer: Any, iterator: dict[str, Any]) -> None:
        """Starts writing a step; the arrays may be donated or changed once this returns."""
        items = ocp.args.Composite(
            trainable=ocp.args.StandardSave(trainable),
            optimizer=ocp.args.StandardSave(optimizer),
            iterator=ocp.args.JsonSave(iterator),
        )
        self._manager.save(step, args=items)

    def save_base(self, frozen: Any) -> None:
        """Writes the frozen variables, if there are any and they are not there yet."""
        if jax.tree.leaves(frozen) and not self._base.exists():
            with ocp.StandardCheckpointer() as checkpointer:
                checkpointer.save(self._base, frozen)

    def restore_base(self, like: Any) -> Any:
        """The frozen variables, with the structure, shapes and shardings of `like`."""
        if not jax.tree.leaves(like):
            return like
        if not self._base.exists():
            raise CheckpointError(f"{self._base}: the frozen base of this run is missing; train the run again")
        with ocp.StandardCheckpointer() as checkpointer:
            require_same_shapes(checkpointer.metadata(self._base).item_metadata, like, self._base)
            return checkpointer.restore(self._base, _abstract(like))

    def restore(self, trainable: Any, optimizer: Any = None) -> Restored:
        """The newest step, with the structure of the trees given; the optimizer and iterator only if asked for.

        Raises CheckpointError where there is no complete step, or where it belongs to a model of another size.
        """
        step = self._require_step()
        where = self.folder / str(step)
        stored = self._manager.item_metadata(step)["trainable"]
        require_same_shapes(stored, trainable, where)
        items: dict[str, ocp.args.CheckpointArgs] = {"trainable": ocp.args.StandardRestore(_abstract(trainable))}
        if optimizer is not None:
            items["optimizer"] = ocp.args.StandardRestore(_abstract(optimizer))
            items["iterator"] = ocp.args.JsonRestore()
        restored = self._manager.restore(step, args=ocp.args.Composite(**items))
        return Restored(step, restored["trainable"], restored.get("optimizer"), restored.get("iterator"))

    def restore_variables(self, like: Any) -> Any:
        """All variables of the newest step, trained and frozen joined, with the structure and shapes of `like`."""
        step = self._require_step()
        flat = traverse_util.flatten_dict(like)
        stored = traverse_util.flatten_dict(_tree(self._manager.item_metadata(step)["trainable"]))
        frozen = {path: leaf for path, leaf in flat.items() if path not in stored} if self._base.exists() else {}
        trainable = {path: leaf for path, leaf in flat.items() if path not in frozen}
        variables = traverse_util.flatten_dict(self.restore(traverse_util.unflatten_dict(trainable)).trainable)
        variables |= traverse_util.flatten_dict(self.restore_base(traverse_util.unflatten_dict(frozen)))
        return traverse_util.unflatten_dict(variables)

    def list_variables(self) -> dict[tuple[str, ...], StoredVariable]:
        """Every variable of the newest step, trained or frozen, by its path; none is read."""
        step = self._require_step()
        items = [(self.folder / str(step) / "trainable", self._manager.item_metadata(step)["trainable"])]
        if self._base.exists():
            with ocp.StandardCheckpointer() as checkpointer:
                items.insert(0, (self._base, checkpointer.metadata(self._base).item_metadata))
        return {
            path: StoredVariable(folder, path, tuple(leaf.shape))
            for folder, metadata in items
            for path, leaf in traverse_util.flatten_dict(_tree(metadata)).items()
        }

    def _require_step(self) -> int:
        self._manager.wait_until_finished()
        step = self.latest_step
        if step is None:
            raise CheckpointError(
                f"{self.folder}: no complete checkpoint; train first: python train.py CONFIG --run {self.folder.parent}"
            )
        return step

    def close(self) -> None:
        """Waits until everything is on disk."""
        self._manager.wait_until_finished()
        self._manager.close()


def require_same_shapes(stored: Any, expected: Any, where: Path) -> None:
    """Raises CheckpointError naming the first parameters that a checkpoint lacks, or holds in another shape."""
    found = {"/".join(map(str, path)): leaf.shape for path, leaf in traverse_util.flatten_dict(_tree(stored)).items()}
    wanted = {"/".join(map(str, path)): leaf.shape for path, leaf in traverse_util.flatten_dict(expected).items()}
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


def _tree(metadata: Any) -> Any:
    """The nested dict inside orbax's metadata of an item."""
    return getattr(metadata, "tree", metadata)


def _abstract(tree: Any) -> Any:
    return jax.tree.map(ocp.utils.to_shape_dtype_struct, tree)
