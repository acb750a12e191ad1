"""The folder of one run: whose it is, and who may write to it."""

import contextlib
import shutil
from collections.abc import Iterator
from pathlib import Path

import jax

from dsvla_jax.checkpoints.steps import has_checkpoints
from dsvla_jax.checkpoints.storage import CheckpointError
from dsvla_jax.experiment import Experiment, load_experiment, outcome_differences
from dsvla_jax.files import hold_folder
from dsvla_jax.training.distributed import first_process_first


def require_same_experiment(run: Path, experiment: Experiment) -> None:
    """Raises CheckpointError where the run folder holds a run that would have learned something else.

    A run that has not come to a checkpoint has learned nothing yet: it may be started again with another config.
    """
    config = run / "config.json"
    if not config.exists() or not has_checkpoints(run):
        return
    if fields := outcome_differences(load_experiment(config), experiment):
        raise CheckpointError(
            f"{config}: this run was started with another config (another {', '.join(fields)}); "
            "go on with the same one, or choose another --run"
        )


def remove_other_start(run: Path, experiment: Experiment) -> None:
    """Removes what a run of another config left that has not come to a checkpoint: its base is not this one's."""
    config = run / "config.json"
    with first_process_first("an earlier start"):
        if jax.process_index() == 0 and config.exists() and outcome_differences(load_experiment(config), experiment):
            for name in ("base", "skipped", "profile"):
                shutil.rmtree(run / name, ignore_errors=True)


@contextlib.contextmanager
def run_folder(run: Path) -> Iterator[None]:
    """Makes the run folder. Takes a new one away again if the run fails before its config is written."""
    new = not run.exists()
    run.mkdir(parents=True, exist_ok=True)
    try:
        yield
    except BaseException:
        if new and not (run / "config.json").exists():
            shutil.rmtree(run, ignore_errors=True)
        raise


@contextlib.contextmanager
def only_one_process(run: Path) -> Iterator[None]:
    """Holds the run folder against another train.py; the system lets go of it however this one ends."""
    with hold_folder(run, "is training this run") if jax.process_index() == 0 else contextlib.nullcontext():
        yield
