"""The checkpoints of one run folder: saved while training continues, and restored by whoever needs them."""

import contextlib
import dataclasses
import hashlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Literal

import jax
import orbax.checkpoint as ocp
from flax import traverse_util

from dsvla_jax.checkpoints.base import restore_base, save_base
from dsvla_jax.checkpoints.digests import FILE as DIGESTS
from dsvla_jax.checkpoints.digests import damage, write_digests
from dsvla_jax.checkpoints.retention import best_step, metrics_of, reading_options, writing_options
from dsvla_jax.checkpoints.steps import first_process_decides, list_steps, tidy
from dsvla_jax.checkpoints.storage import (
    PATTERN_CHARACTERS,
    SEPARATOR,
    CheckpointError,
    PyTree,
    abstract,
    require_index,
    require_same_shapes,
    require_writable_path,
    tree_of,
)
from dsvla_jax.checkpoints.variables import StoredVariable, stored_variables
from dsvla_jax.json_values import Json


@dataclasses.dataclass(frozen=True)
class Arrays:
    """What a step keeps as arrays, each an item of its own on disk.

    trainable: the variables that learn, by collection and module. optimizer: the optimizer's state over exactly those.
    counters: int32 (); rng: random keys; both by the names on disk, which the training loop chooses. average: the
    moving average of the variables that learn, by which the policy acts; empty where there is none, and then no item on
    disk.
    """

    trainable: PyTree
    optimizer: PyTree
    counters: Mapping[str, jax.Array]
    rng: Mapping[str, jax.Array]
    average: PyTree = dataclasses.field(default_factory=dict)

    def items(self) -> dict[str, PyTree]:
        """Those that are on disk, by name."""
        return {name: tree for name, tree in vars(self).items() if name != AVERAGE or jax.tree.leaves(tree)}


@dataclasses.dataclass(frozen=True)
class Notes:
    """What a step keeps as JSON. iterator: the position in the data. config: the experiment."""

    iterator: dict[str, Json]
    config: dict[str, Json]


@dataclasses.dataclass(frozen=True)
class Restored:
    """What a step of a run held."""

    step: int
    arrays: Arrays
    notes: Notes


AVERAGE = "average"
ARRAYS = tuple(field.name for field in dataclasses.fields(Arrays))
NOTES = tuple(field.name for field in dataclasses.fields(Notes))


class RunCheckpoints:
    """The checkpoints of one run folder; writes in the background.

    keep: how many of the newest steps stay. The step with the lowest score stays too.
    read_only: for all but the program that trains the run: touches nothing.

    On opening, a newest step that is not as it was written is reported and, unless `read_only`, put aside; the newest
    whole one takes its place. Raises CheckpointError for a path that nothing can be stored at.
    """

    def __init__(self, run: Path, *, keep: int = 2, read_only: bool = False) -> None:
        require_writable_path(run, SEPARATOR if read_only else PATTERN_CHARACTERS + SEPARATOR)
        self.folder = run.absolute() / "checkpoints"
        self._base = run.absolute() / "base"
        self._read_only = read_only
        self._saving: tuple[str, ...] = ()
        self._newest = first_process_decides(lambda: tidy(self.folder, read_only))
        options = reading_options() if read_only else writing_options(keep, self._write_digests)
        handlers = {name: ocp.StandardCheckpointHandler() for name in ARRAYS}
        handlers |= {name: ocp.JsonCheckpointHandler() for name in NOTES}
        self._manager = ocp.CheckpointManager(self.folder, options=options, item_handlers=handlers)

    @property
    def latest_step(self) -> int | None:
        """The newest whole step, or None."""
        return self._newest if self._read_only else self._manager.latest_step()

    @property
    def best_step(self) -> int | None:
        """The step with the lowest score, or None if none was scored."""
        return best_step(self._manager)

    def save(self, step: int, arrays: Arrays, notes: Notes, score: float | None = None) -> None:
        """Starts writing a step; the arrays may be donated or changed once this returns.

        score: the lower the better.
        Raises CheckpointError if this step cannot be written, or the one before it could not: nothing that was whole is
        lost.
        """
        items: dict[str, ocp.args.CheckpointArgs] = {
            name: ocp.args.StandardSave(tree) for name, tree in arrays.items().items()
        }
        items |= {name: ocp.args.JsonSave(note) for name, note in vars(notes).items()}
        with self._explained():
            self._manager.wait_until_finished()
            self._saving = tuple(name for name, tree in vars(arrays).items() if jax.tree.leaves(tree))
            self._manager.save(step, args=ocp.args.Composite(**items), metrics=metrics_of(score))

    def raise_if_failed(self) -> None:
        """Raises CheckpointError if the step that was being written could not be. Never waits."""
        if not self._manager.is_saving_in_progress():
            self.wait()

    def wait(self) -> None:
        """Waits until everything is on disk. Raises CheckpointError where it could not be written."""
        with self._explained():
            self._manager.wait_until_finished()

    def restore(self, like: Arrays, step: int | None = None) -> Restored:
        """Reads a step, the newest by default, with the structures, shapes and shardings of `like`.

        It may have been saved from another mesh and another number of processes. Leaves without a sharding are restored
        to the first device.
        Raises CheckpointError if there is no such step, or it belongs to a model of another size.
        """
        step = self._require_step(step)
        restored = self._read(step, like.items(), NOTES)
        arrays = Arrays(**{name: restored[name] for name in like.items()})
        return Restored(step, arrays, Notes(**{name: restored[name] for name in NOTES}))

    def _read(self, step: int, like: Mapping[str, PyTree], notes: tuple[str, ...]) -> Mapping[str, PyTree]:
        """Items of a step by name: arrays as `like` has them, and notes."""
        learned = "trainable" if "trainable" in like else AVERAGE
        require_same_shapes(self._manager.item_metadata(step)[learned], like[learned], self.folder / str(step))
        items: dict[str, ocp.args.CheckpointArgs] = {
            name: ocp.args.StandardRestore(abstract(tree)) for name, tree in like.items()
        }
        items |= {name: ocp.args.JsonRestore() for name in notes}
        return self._manager.restore(step, args=ocp.args.Composite(**items))

    def save_base(self, frozen: PyTree) -> None:
        """Writes the frozen variables; see `dsvla_jax.checkpoints.base`."""
        save_base(self._base, frozen)

    def restore_base(self, like: PyTree) -> PyTree:
        """Reads the frozen variables; see `dsvla_jax.checkpoints.base`."""
        return restore_base(self._base, like)

    def restore_variables(self, like: PyTree, step: int | Literal["best"] | None = None) -> PyTree:
        """All variables of a step by which the policy acts, with the structure and shapes of `like`.

        They are the trained ones, or their average where the run keeps one, and the frozen ones.

        step: a number, "best", or the newest if not given.
        """
        number = self._require_step(self._number(step))
        flat = traverse_util.flatten_dict(like)
        stored = traverse_util.flatten_dict(tree_of(self._manager.item_metadata(number)["trainable"]))
        frozen = {path: leaf for path, leaf in flat.items() if path not in stored} if self._base.exists() else {}
        trainable = {path: leaf for path, leaf in flat.items() if path not in frozen}
        acting = AVERAGE if (self.folder / str(number) / AVERAGE).exists() else "trainable"
        restored = self._read(number, {acting: traverse_util.unflatten_dict(trainable)}, notes=())
        variables = traverse_util.flatten_dict(restored[acting])
        variables |= traverse_util.flatten_dict(self.restore_base(traverse_util.unflatten_dict(frozen)))
        return traverse_util.unflatten_dict(variables)

    def identify(self, step: int | Literal["best"] | None = None) -> tuple[int, str]:
        """The step that `restore_variables` restores, and a digest of all that it would read."""
        number = self._require_step(self._number(step))
        files = [self.folder / str(number) / DIGESTS, self._base / DIGESTS]
        content = b"".join(file.read_bytes() for file in files if file.exists())
        return number, hashlib.sha256(content).hexdigest()[:16]

    def _number(self, step: int | Literal["best"] | None) -> int | None:
        if step == "best" and self.best_step is None:
            raise CheckpointError(
                f"{self.folder}: no checkpoint was scored, so none is the best; name a step, or train with "
                "--validate-every or --evaluate-every"
            )
        return self.best_step if step == "best" else step

    def list_variables(self) -> dict[tuple[str, ...], StoredVariable]:
        """Every variable of the newest step, trained or frozen, by its path; none is read."""
        step = self._require_step(None)
        items = [(self.folder / str(step) / "trainable", self._manager.item_metadata(step)["trainable"])]
        if self._base.exists():
            with ocp.StandardCheckpointer() as checkpointer:
                items.insert(0, (self._base, checkpointer.metadata(self._base).item_metadata))
        return stored_variables(items)

    def _require_step(self, step: int | None) -> int:
        self._manager.wait_until_finished()
        if step is not None and step != self.latest_step:
            present = sorted(self._manager.all_steps())
            if step not in present:
                raise CheckpointError(f"{self.folder}: no checkpoint of step {step}; there are {present or 'none'}")
            if problem := damage(self.folder / str(step)):
                raise CheckpointError(f"{self.folder / str(step)} is damaged: {problem}; choose one of {present}")
        step = self.latest_step if step is None else step
        if step is None:
            raise CheckpointError(
                f"{self.folder}: no complete checkpoint; train first: python train.py CONFIG --run {self.folder.parent}"
            )
        return step

    def _write_digests(self) -> None:
        # Called in the background when all files of a step are written, before the folder gets its final name.
        if jax.process_index() == 0:
            for folder in self.folder.glob("*.orbax-checkpoint-tmp"):
                for name in self._saving:
                    require_index(folder / name)
                # Orbax keeps writing to the files at the top; they hold nothing that is restored.
                write_digests(folder, top=False)

    @contextlib.contextmanager
    def _explained(self) -> Iterator[None]:
        # A full disk is an OSError where Python writes, and a ValueError where TensorStore does.
        try:
            yield
        except (OSError, ValueError) as error:
            steps = list_steps(self.folder)
            whole = f"the checkpoint of step {steps[-1]} is whole" if steps else "there is no earlier one"
            raise CheckpointError(
                f"{self.folder}: a checkpoint could not be written ({str(error).splitlines()[0][:300]}); {whole}. "
                "Free space, or make the folder writable, and give the same command again to resume"
            ) from error

    def close(self) -> None:
        """Waits until everything is on disk. Raises CheckpointError where it could not be written."""
        try:
            self.wait()
        finally:
            self._manager.close()
