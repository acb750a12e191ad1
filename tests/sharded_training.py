"""Trains a tiny model on virtual devices and prints its losses as JSON: python -m tests.sharded_training OPTIONS.

With --run it goes on from the checkpoint there, whose digest it prints first; or writes it where there is none. With
--validate it prints the figures of validation at the end.

Tests start it in processes of its own, because the number of devices is fixed once JAX has started.
"""

import contextlib
import dataclasses
import hashlib
import json
import sys
from functools import partial
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jax.experimental import multihost_utils

from dsvla_jax.checkpoints.run import Notes, RunCheckpoints
from dsvla_jax.encoding.number_targets import NumberTargets
from dsvla_jax.experiment import Experiment, MeshConfig, OptimizerConfig
from dsvla_jax.model.config import LoraConfig, ModelConfig, VisualPromptConfig
from dsvla_jax.model.partition import make_sharded
from dsvla_jax.training.loop import arrays_of, state_of
from dsvla_jax.training.sharding import batch_part, make_mesh, put_batch
from dsvla_jax.training.state import jit_train_step, make_optimizer
from dsvla_jax.training.validation import jit_validation, mean_errors
from dsvla_jax.types import Example, HeldOutExample
from tests.learning import learner_of, start_of, step_of
from tests.random_data import random_example
from tests.small import small_encoding, small_language, small_vision

VOCABULARY = 40
# One choice of a bin, between four tokens.
TARGETS = NumberTargets(
    tokens=np.arange(4, 8, dtype=np.int32),
    offsets=np.array([[np.inf] * 4, [0, 1, 2, 3]], np.float32),
    weights=np.array([[0.0] * 4, [0.6, 0.3, 0.1, 0.0]], np.float32),
    begins=np.array([False, True]),
)


def tiny_experiment(fusion: Any = "prefix", points: bool = True, **changes: Any) -> Experiment:
    """Both towers with adapters, and a batch of 16 that learns something in 20 steps."""
    encoding = small_encoding(max_text_length=16, use_points=points)
    model = ModelConfig(
        vision=small_vision(2),
        language=small_language(VOCABULARY, 2),
        fusion=fusion,
        visual_prompt=VisualPromptConfig(width=32, layers=2, heads=2, ffn=64),
        lora=LoraConfig(rank=2),
        remat="none",
    )
    experiment = Experiment(
        encoding=encoding,
        model=model,
        optimizer=OptimizerConfig(learning_rate=1e-3),
        regime="lora",
        steps=20,
        batch_size=16,
    )
    return dataclasses.replace(experiment, **changes)


def batches(experiment: Experiment) -> list[Example[np.ndarray]]:
    """Three batches of noise, whose answers have different lengths, so that no mean over parts is right by chance."""
    rng = np.random.default_rng(0)
    size, text = experiment.batch_size, experiment.encoding.max_text_length

    def batch() -> Example[np.ndarray]:
        place, length = np.arange(text), rng.integers(1, 8, (size, 1))
        answer = (place >= 8) & (place < 8 + length)
        example = random_example(rng, answer, VOCABULARY)
        rows = np.where(answer & (rng.random((size, text)) < 0.5), 1, 0).astype(np.int32)
        return dataclasses.replace(example, number_rows=rows)

    return [batch() for _ in range(3)]


def digest(tree: Any) -> str:
    """Of all values of a tree, wherever they live."""

    def whole(leaf: Any) -> bytes:
        values = jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf
        return np.asarray(multihost_utils.process_allgather(values, tiled=True)).tobytes()

    return hashlib.sha256(b"".join(map(whole, jax.tree.leaves(tree)))).hexdigest()


def validation_batch(batch: Example[np.ndarray]) -> HeldOutExample[np.ndarray]:
    """The batch as if all its choices belonged to the first number of an answer, which is 2."""
    integers = np.zeros((len(batch.number_rows), 2, 8), np.int32)
    integers[:, 0, 0] = 2
    return HeldOutExample(batch, integers, np.where(batch.number_rows > 0, 1, 0).astype(np.int32))


def train(experiment: Experiment, devices: int, run: Path | None, until: int, validates: bool) -> list[float]:
    """The losses of a run on the first so many devices (0: all), up to a step."""
    mesh = make_mesh(experiment.mesh, jax.devices()[:devices] if devices else None)
    values = np.full(VOCABULARY, np.nan, np.float32)
    optimizer = make_optimizer(experiment.optimizer, experiment.steps)
    state, frozen = make_sharded(partial(start_of, experiment, values, optimizer), mesh)
    step = jit_train_step(step_of(experiment, optimizer, TARGETS), state, mesh)
    part = batch_part(mesh, experiment.batch_size, experiment.gradient_accumulation)
    mine = slice(part.index * part.size, (part.index + 1) * part.size)
    parts = [jax.tree.map(lambda leaf: leaf[mine], batch) for batch in batches(experiment)]
    data = [put_batch(batch, mesh) for batch in parts]
    new = run is not None and not (run / "checkpoints").exists()
    if run is not None and not new:
        with contextlib.closing(RunCheckpoints(run, read_only=True)) as checkpoints:
            frozen = checkpoints.restore_base(frozen)
            state = state_of(checkpoints.restore(arrays_of(state)))
        print("restored", digest((state, frozen)), flush=True)
    losses = []
    for index in range(int(state.step), until):
        before = state
        with jax.transfer_guard("disallow"):
            state, metrics = step(state, frozen, data[index % 3])
        assert all(leaf.is_deleted() for leaf in jax.tree.leaves(before)), "the state is donated to the step"
        losses.append(float(metrics["loss"]))
    if new and run is not None:
        with contextlib.closing(RunCheckpoints(run)) as checkpoints:
            checkpoints.save_base(frozen)
            checkpoints.save(until, arrays_of(state), Notes(iterator={}, config={}))
        print("saved", digest((state, frozen)), flush=True)
    if validates:
        sums = jit_validation(learner_of(experiment, TARGETS), mesh)
        figures = mean_errors(sums, state.trainable, frozen, map(validation_batch, parts), mesh)
        print("validation", json.dumps(figures), flush=True)
    return losses


@dataclasses.dataclass(frozen=True)
class Options:
    """Where to train. meshes: "data,fsdp,tensor" each. devices: of each mesh, 0 for all."""

    meshes: tuple[str, ...]
    devices: tuple[int, ...]
    accumulation: tuple[int, ...]
    coordinator: str = ""
    process: int = 0
    processes: int = 1
    fusion: str = "prefix"
    method: Literal["adamw", "muon"] = "adamw"
    points: bool = False
    run: Path | None = None
    until: int = 20
    validate: bool = False


def main(options: Options) -> None:
    if options.coordinator:
        jax.distributed.initialize(options.coordinator, options.processes, options.process)
    for mesh, devices, parts in zip(options.meshes, options.devices, options.accumulation, strict=True):
        config = MeshConfig(*map(int, mesh.split(",")))
        experiment = tiny_experiment(options.fusion, options.points, mesh=config, gradient_accumulation=parts)
        if options.method == "muon":
            # All parameters learn: adapters alone have few matrices.
            optimizer = dataclasses.replace(experiment.optimizer, method="muon")
            experiment = dataclasses.replace(experiment, optimizer=optimizer, regime="full")
        print(
            "losses", json.dumps(train(experiment, devices, options.run, options.until, options.validate)), flush=True
        )


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Options)))
