"""Saving and restoring pytrees: what training resumes from, and what a policy is loaded from.

A run folder holds

    checkpoints/<step>/   orbax: `trainable`, `optimizer`, `counters` and `rng` (arrays), `iterator` (the position in
                          the data) and `config` (JSON), `metrics` (what the step was judged by), and digests.json, the
                          size and sha256 of every file. It appears whole or not at all
    checkpoints/damaged/  steps whose files are not those that were written, put aside
    base/                 orbax: the frozen variables, written once, with digests.json; absent when everything is
                          trained

Weights imported from elsewhere are a folder of their own (`dsvla_jax.weights.folder`).
"""

import contextlib
import dataclasses
import hashlib
import logging
import math
import shutil
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np
import orbax.checkpoint as ocp
from flax import traverse_util
from jax.experimental import multihost_utils
from orbax.checkpoint.checkpoint_managers import preservation_policy

from dsvla_jax.digests import FILE as DIGESTS
from dsvla_jax.digests import damage, write_digests
from dsvla_jax.errors import UserError

ARRAYS = ("trainable", "optimizer", "counters", "rng")
NOTES = ("iterator", "config")
ARRAY_INDEX = "manifest.ocdbt"

_log = logging.getLogger(__name__)


class CheckpointError(UserError):
    """A checkpoint is missing, damaged, cannot be written, or does not fit the model that asks for it."""


logging.getLogger("absl").setLevel(logging.WARNING)

# Orbax looks for what it wrote with a pattern that begins with the folder's own path; TensorStore takes a backslash for
# a slash.
PATTERN_CHARACTERS, SEPARATOR = "[*?", "\\"


def require_writable_path(folder: Path, characters: str = PATTERN_CHARACTERS + SEPARATOR) -> None:
    """Raises CheckpointError if the absolute path has any of the characters: arrays written there could not be read."""
    if found := [character for character in characters if character in str(folder.absolute())]:
        raise CheckpointError(
            f"{folder.absolute()}: arrays cannot be stored in a folder whose path contains {' or '.join(found)}; "
            "choose another folder"
        )


@dataclasses.dataclass(frozen=True)
class Restored:
    """What a step of a run held: arrays by the names of `ARRAYS`, as asked for, and notes by those of `NOTES`."""

    step: int
    arrays: dict[str, Any]
    notes: dict[str, Any]


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
    """The checkpoints of one run folder; writes in the background.

    keep: how many of the newest steps stay. The step with the lowest score stays too.
    read_only: for all but the program that trains the run: touches nothing.

    On opening, a newest step that is not as it was written is reported and, unless `read_only`, put aside; the newest
    whole one takes its place. Raises CheckpointError for a path that nothing can be stored at.
    """

    def __init__(self, run: Path, *, keep: int = 2, read_only: bool = False):
        require_writable_path(run, SEPARATOR if read_only else PATTERN_CHARACTERS + SEPARATOR)
        self.folder = run.absolute() / "checkpoints"
        self._base = run.absolute() / "base"
        self._read_only = read_only
        self._saving: tuple[str, ...] = ()
        self._newest = _first_process_decides(lambda: _tidy(self.folder, read_only))
        if read_only:
            options = ocp.CheckpointManagerOptions(read_only=True, create=False, best_fn=_rank)
        else:
            latest = preservation_policy.LatestN(keep)
            best = preservation_policy.BestN(get_metric_fn=_rank, n=1, keep_checkpoints_without_metrics=False)
            options = ocp.CheckpointManagerOptions(
                best_fn=_rank,
                preservation_policy=preservation_policy.AnyPreservationPolicy([latest, best]),
                async_options=ocp.AsyncOptions(
                    post_finalization_callback=self._write_digests,
                    # Where a folder cannot be made in the background, orbax's other threads wait for it for minutes.
                    create_directories_asynchronously=False,
                ),
            )
        handlers = {name: ocp.StandardCheckpointHandler() for name in ARRAYS}
        handlers |= {name: ocp.JsonCheckpointHandler() for name in NOTES}
        self._manager = ocp.CheckpointManager(self.folder, options=options, item_handlers=handlers)

    @property
    def latest_step(self) -> int | None:
        """The newest whole step, or None."""
        return self._newest if self._read_only else self._manager.latest_step()

    @property
    def best_step(self) -> int | None:
        """The step with the lowest score, or None where none was scored."""
        scores = {step: (self._manager.metrics(step) or {}).get("score") for step in self._manager.all_steps()}
        scored = {step: score for step, score in scores.items() if score is not None}
        return min(scored, key=scored.__getitem__, default=None)

    def save(self, step: int, arrays: Mapping[str, Any], notes: Mapping[str, Any], score: float | None = None) -> None:
        """Starts writing a step; the arrays may be donated or changed once this returns.

        arrays, notes: pytrees by the names of `ARRAYS`, and JSON by those of `NOTES`; training gives them all.
        score: the lower the better.
        Raises CheckpointError where this step cannot be written, or the one before it could not: nothing that was
        whole is lost.
        """
        items: dict[str, Any] = {name: ocp.args.StandardSave(tree) for name, tree in arrays.items()}
        items |= {name: ocp.args.JsonSave(note) for name, note in notes.items()}
        with self._explained():
            self._manager.wait_until_finished()
            self._saving = tuple(name for name, tree in arrays.items() if jax.tree.leaves(tree))
            self._manager.save(
                step, args=ocp.args.Composite(**items), metrics={} if score is None else {"score": score}
            )

    def raise_if_failed(self) -> None:
        """Raises CheckpointError if the step that was being written could not be. Never waits."""
        if not self._manager.is_saving_in_progress():
            self.wait()

    def wait(self) -> None:
        """Waits until everything is on disk. Raises CheckpointError where it could not be written."""
        with self._explained():
            self._manager.wait_until_finished()

    def restore(self, arrays: Mapping[str, Any], step: int | None = None) -> Restored:
        """A step, the newest by default, with the structures, shapes and shardings of `arrays`, which names what is
        wanted of `ARRAYS`. It may have been saved from another mesh and another number of processes. Leaves without a
        sharding are restored to the first device.

        Raises CheckpointError where there is no such step, or where it belongs to a model of another size.
        """
        step = self._require_step(step)
        where = self.folder / str(step)
        stored = self._manager.item_metadata(step)
        require_same_shapes(stored["trainable"], arrays["trainable"], where)
        items: dict[str, Any] = {name: ocp.args.StandardRestore(_abstract(tree)) for name, tree in arrays.items()}
        notes = [name for name in NOTES if (where / name).exists()]
        items |= {name: ocp.args.JsonRestore() for name in notes}
        restored = self._manager.restore(step, args=ocp.args.Composite(**items))
        return Restored(step, {name: restored[name] for name in arrays}, {name: restored[name] for name in notes})

    def save_base(self, frozen: Any) -> None:
        """Writes the frozen variables, if there are any and they are not there yet, and the digests of their files."""
        # Without its digests a base is one whose writing was cut short.
        if jax.tree.leaves(frozen) and not (self._base / DIGESTS).exists():
            with ocp.StandardCheckpointer() as checkpointer:
                checkpointer.save(self._base, frozen, force=True)
            if jax.process_index() == 0:
                _require_index(self._base)
                write_digests(self._base, top=True)

    def restore_base(self, like: Any) -> Any:
        """The frozen variables, with the structure, shapes and shardings of `like`."""
        if not jax.tree.leaves(like):
            return like
        if not self._base.exists():
            raise CheckpointError(f"{self._base}: the frozen base of this run is missing; train the run again")
        if jax.process_index() == 0 and (problem := damage(self._base)):
            raise CheckpointError(
                f"{self._base} is damaged: {problem}; put back a copy of the folder, or train again with another --run"
            )
        with ocp.StandardCheckpointer() as checkpointer:
            require_same_shapes(checkpointer.metadata(self._base).item_metadata, like, self._base)
            return checkpointer.restore(self._base, _abstract(like))

    def restore_variables(self, like: Any, step: int | Literal["best"] | None = None) -> Any:
        """All variables of a step, trained and frozen joined, with the structure and shapes of `like`.

        step: a number, "best", or the newest if not given.
        """
        number = self._require_step(self._number(step))
        flat = traverse_util.flatten_dict(like)
        stored = traverse_util.flatten_dict(_tree(self._manager.item_metadata(number)["trainable"]))
        frozen = {path: leaf for path, leaf in flat.items() if path not in stored} if self._base.exists() else {}
        trainable = {path: leaf for path, leaf in flat.items() if path not in frozen}
        restored = self.restore({"trainable": traverse_util.unflatten_dict(trainable)}, number)
        variables = traverse_util.flatten_dict(restored.arrays["trainable"])
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
        return {
            path: StoredVariable(folder, path, tuple(leaf.shape))
            for folder, metadata in items
            for path, leaf in traverse_util.flatten_dict(_tree(metadata)).items()
        }

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
                    _require_index(folder / name)
                # Orbax goes on writing to the files at the top; they hold nothing that is restored.
                write_digests(folder, top=False)

    @contextlib.contextmanager
    def _explained(self) -> Iterator[None]:
        # A full disk is an OSError where Python writes, and a ValueError where TensorStore does.
        try:
            yield
        except (OSError, ValueError) as error:
            steps = _steps(self.folder)
            whole = f"the checkpoint of step {steps[-1]} is whole" if steps else "there is no earlier one"
            raise CheckpointError(
                f"{self.folder}: a checkpoint could not be written ({str(error).splitlines()[0][:300]}); {whole}. "
                "Free space, or make the folder writable, and give the same command again: it goes on from there"
            ) from error

    def close(self) -> None:
        """Waits until everything is on disk. Raises CheckpointError where it could not be written."""
        try:
            self.wait()
        finally:
            self._manager.close()


def _require_index(item: Path) -> None:
    """Raises CheckpointError if arrays were written without the index through which they are found."""
    if not (item / ARRAY_INDEX).is_file():
        raise CheckpointError(f"{item}: {ARRAY_INDEX} is missing, so its arrays could not be read")


def has_checkpoints(run: Path) -> bool:
    """Whether a run folder holds a checkpoint, be it a damaged one."""
    folder = run / "checkpoints"
    return bool(_steps(folder)) or (folder / "damaged").exists()


def _steps(folder: Path) -> list[int]:
    """The steps that are in the folder under their final names."""
    return sorted(int(path.name) for path in folder.glob("*") if path.name.isdigit())


def _tidy(folder: Path, read_only: bool) -> int | None:
    """The newest whole step; removes what a killed run had begun to write, unless `read_only`."""
    if not read_only:
        # orbax would do it in a thread that a run which fails at once does not wait for, and that then dies loudly.
        for unfinished in ocp.utils.tmp_checkpoints(folder):
            shutil.rmtree(unfinished.get())
    return _newest_whole_step(folder, put_aside=not read_only)


def _newest_whole_step(folder: Path, put_aside: bool) -> int | None:
    """The newest step without damage; reports newer ones and, if asked, moves them to ``damaged``."""
    damaged: dict[int, str] = {}
    for step in reversed(_steps(folder)):
        if problem := damage(folder / str(step)):
            damaged[step] = problem
            continue
        for number, problem in damaged.items():
            _log.warning("%s/%d is DAMAGED: %s. Falling back to step %d", folder, number, problem, step)
            if put_aside:
                _log.warning("it was moved to %s", _move_aside(folder / str(number)))
        return step
    if damaged:
        listed = "; ".join(f"step {step}: {problem}" for step, problem in damaged.items())
        raise CheckpointError(f"{folder}: every checkpoint is damaged ({listed}); train again with another --run")
    return None


def _move_aside(step_folder: Path) -> Path:
    """Moves a folder into ``damaged`` beside it, under a name that is not taken."""
    target = step_folder.parent / "damaged" / step_folder.name
    taken = 1
    while target.exists():
        taken += 1
        target = target.with_name(f"{step_folder.name}-{taken}")
    target.parent.mkdir(exist_ok=True)
    step_folder.rename(target)
    return target


def _first_process_decides(decide: Callable[[], int | None]) -> int | None:
    """What the first process decides, told to all of them. The others wait until it has."""
    chosen = decide() if jax.process_index() == 0 else None
    if jax.process_count() == 1:
        return chosen
    number = int(multihost_utils.broadcast_one_to_all(np.int32(-1 if chosen is None else chosen)))
    return None if number < 0 else number


def _rank(metrics: Mapping[str, float]) -> float:
    """The higher the better."""
    return -metrics.get("score", float("inf"))


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
    """What orbax is to restore: leaves without a sharding go to one device, whatever devices they were saved from."""
    # Orbax would otherwise look for the devices that saved them.
    here = jax.sharding.SingleDeviceSharding(jax.local_devices()[0])

    def abstract(leaf: Any) -> Any:
        struct = ocp.utils.to_shape_dtype_struct(leaf)
        lacks_sharding = isinstance(struct, jax.ShapeDtypeStruct) and struct.sharding is None
        return struct.update(sharding=here) if lacks_sharding else struct

    return jax.tree.map(abstract, tree)
