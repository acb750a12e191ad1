"""Where a run's numbers go: metrics.jsonl and TensorBoard always, Weights & Biases where asked for."""

import json
import math
import os
import secrets
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import jax
from tensorboardX import SummaryWriter

from dsvla_jax.errors import UserError
from dsvla_jax.files import replacing

if TYPE_CHECKING:
    import wandb  # pyright: ignore[reportMissingImports]

FILE = "metrics.jsonl"


class MetricsWriter:
    """Writes one line a step, in process 0.

    A run that resumes from a checkpoint first forgets what came after it, so that the file holds each step once.

    step: that of the checkpoint, or 0. wandb_project: the Weights & Biases project to write to as well, if any.
    """

    def __init__(
        self, run: Path, step: int, wandb_project: str = "", config: Mapping[str, object] | None = None
    ) -> None:
        writes = jax.process_index() == 0
        self._path = run / FILE if writes else Path(os.devnull)
        if writes:
            rewind(self._path, step)
        self._file = self._path.open("a")
        # TensorBoard hides what an earlier process wrote from this step on.
        self._board = SummaryWriter(str(run / "tensorboard"), purge_step=step + 1, write_to_disk=writes)
        self._wandb = _start_wandb(run, wandb_project, config or {}) if wandb_project and writes else None

    def write(self, step: int, values: Mapping[str, float]) -> None:
        """Writes the numbers of a step. One that is not finite becomes null in the file."""
        finite = {name: value for name, value in values.items() if math.isfinite(value)}
        line = json.dumps({"step": step, **{name: finite.get(name) for name in values}})
        try:
            self._file.write(line + "\n")
            self._file.flush()
        except OSError as error:
            raise UserError(
                f"{self._path}: cannot be written ({error}); free space, or make it writable, and give the same "
                "command again: it goes on from the newest checkpoint"
            ) from error
        for name, value in finite.items():
            self._board.add_scalar(name, value, step)
        if self._wandb is not None:
            self._wandb.log({"step": step, **finite})

    def sync(self) -> None:
        """Makes sure that the lines survive a power failure. Called before a checkpoint that goes on behind them."""
        if self._path.name == FILE:
            os.fsync(self._file.fileno())

    def __enter__(self) -> "MetricsWriter":
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()
        self._board.close()
        if self._wandb is not None:
            self._wandb.finish()


def rewind(path: Path, step: int) -> None:
    """Drops the lines of later steps, and a last one that was cut short. Other lines stay as they are."""
    if not path.exists():
        return
    kept = [line for line in path.read_text().splitlines(keepends=True) if _step_of(line) <= step]
    with replacing(path, durable=True) as partial:
        partial.write_text("".join(kept))


def _step_of(line: str) -> float:
    try:
        return json.loads(line)["step"] if line.endswith("\n") else math.inf
    except ValueError:
        return math.inf


def require_wandb() -> None:
    """Raises UserError where the package of Weights & Biases is not installed."""
    try:
        import wandb  # noqa: F401  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise UserError("--wandb: the package is not installed; install it with: pip install wandb") from error


def _start_wandb(run: Path, project: str, config: Mapping[str, object]) -> "wandb.Run":
    require_wandb()
    import wandb  # pyright: ignore[reportMissingImports]

    name = run / "wandb_id.txt"
    if not name.exists():
        name.write_text(secrets.token_hex(4))
    session = wandb.init(
        project=project, id=name.read_text(), resume="allow", dir=run, name=run.name, config=dict(config)
    )
    # W&B's own counter never goes back, a resumed run does: plots go by ours.
    session.define_metric("step")
    session.define_metric("*", step_metric="step")
    return session
