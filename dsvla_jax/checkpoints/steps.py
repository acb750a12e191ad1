"""Which steps of a run are there, and which of them are as they were written."""

import logging
import shutil
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np
import orbax.checkpoint as ocp
from jax.experimental import multihost_utils

from dsvla_jax.checkpoints.digests import damage
from dsvla_jax.checkpoints.storage import CheckpointError

_log = logging.getLogger(__name__)


def has_checkpoints(run: Path) -> bool:
    """Whether a run folder holds a checkpoint, be it a damaged one."""
    folder = run / "checkpoints"
    return bool(list_steps(folder)) or (folder / "damaged").exists()


def list_steps(folder: Path) -> list[int]:
    """The steps that are in the folder under their final names."""
    return sorted(int(path.name) for path in folder.glob("*") if path.name.isdigit())


def tidy(folder: Path, read_only: bool) -> int | None:
    """The newest whole step; removes what a killed run had begun to write, unless `read_only`."""
    if not read_only:
        # orbax would do it in a thread that a run which fails at once does not wait for, and that then dies loudly.
        for unfinished in ocp.utils.tmp_checkpoints(folder):
            shutil.rmtree(unfinished.get())
    return _newest_whole_step(folder, put_aside=not read_only)


def _newest_whole_step(folder: Path, put_aside: bool) -> int | None:
    """The newest step without damage; reports newer ones and, if asked, moves them to ``damaged``."""
    damaged: dict[int, str] = {}
    for step in reversed(list_steps(folder)):
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


def first_process_decides(decide: Callable[[], int | None]) -> int | None:
    """What the first process decides, sent to all of them. The others wait until it has."""
    chosen = decide() if jax.process_index() == 0 else None
    if jax.process_count() == 1:
        return chosen
    number = int(multihost_utils.broadcast_one_to_all(np.int32(-1 if chosen is None else chosen)))
    return None if number < 0 else number
