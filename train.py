"""Train 3DS-VLA: python train.py CONFIG [--run DIR] [--resume] [--steps 500 --optimizer.learning-rate 3e-4 ...]

CONFIG names a file of configs/. Demonstrations are generated first where they are missing. The run folder receives the
config, the vocabulary, checkpoints, and metrics (metrics.jsonl and TensorBoard).
"""

import dataclasses
import json
import sys
import time
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import jax
import numpy as np
import tyro
from tensorboardX import SummaryWriter
from tqdm import tqdm

import dsvla_jax.policy
from configs import config_names, get_config
from data_pipelines.loader import make_loader
from data_pipelines.oxe.loader import OxeLoader
from data_pipelines.samples import make_sampler, suite_tokenizer
from data_pipelines.sources import choose_tasks, open_demonstrations
from dsvla_jax.checkpoints import CheckpointError, RunCheckpoints, require_same_shapes
from dsvla_jax.command_line import configure_jax, fail_with_message
from dsvla_jax.encoding.number_targets import number_rows
from dsvla_jax.encoding.pretrained_tokenizers import load_tokenizer
from dsvla_jax.encoding.text import Tokenizer
from dsvla_jax.errors import UserError
from dsvla_jax.model.partition import make_sharded
from dsvla_jax.model.vla import VLA, initialize
from dsvla_jax.policy import PolicyConfig, save_policy_config
from dsvla_jax.training.distributed import Watchdog, start_processes
from dsvla_jax.training.experiment import Experiment, load_experiment, save_experiment
from dsvla_jax.training.sharding import BatchPart, batch_part, make_mesh, put_batch
from dsvla_jax.training.state import TrainState, initial_state, jit_train_step, make_optimizer, make_train_step
from dsvla_jax.weights.base import is_imported, load_for_model

# Embeddings have more rows than the vocabulary has tokens where their number was rounded up, by fewer than so many.
PADDING_ROWS = 1024


def main(experiment: Experiment, run: Path, resume: bool, watchdog: Watchdog) -> None:
    """Trains one experiment into the run folder, or goes on from its newest checkpoint."""
    tokenizer = tokenizer_of(experiment)
    if experiment.oxe is None:
        tasks = choose_tasks(experiment.data)
        experiment = dataclasses.replace(experiment, data=dataclasses.replace(experiment.data, tasks=tasks))
    mesh = make_mesh(experiment.mesh)
    part = batch_part(mesh, experiment.batch_size, experiment.gradient_accumulation)
    prepare_run_folder(run, experiment, resume)
    checkpoints = RunCheckpoints(run)
    if checkpoints.latest_step == experiment.steps:
        checkpoints.close()
        print(f"{run} has been trained to step {experiment.steps}: nothing to do")
        return
    loader, samples = open_data(experiment, tokenizer, part)

    model = VLA(experiment.model)
    optimizer = make_optimizer(experiment.optimizer, experiment.steps)
    start = partial(initial_state, experiment, tokenizer.number_values, optimizer)
    state, frozen = make_sharded(start, mesh, base_variables(experiment, mesh))
    report_size(state.trainable, frozen, samples)

    if checkpoints.latest_step is not None:
        frozen = checkpoints.restore_base(frozen)
        restored = checkpoints.restore(state.trainable, state.optimizer)
        step = jax.device_put(np.int32(restored.step), state.step.sharding)
        state = TrainState(step, restored.trainable, restored.optimizer)
        loader.set_state(restored.iterator)
        print(f"resuming {run} at step {restored.step}")
    else:
        save_experiment(run / "config.json", experiment)
        displacement = loader.scale if isinstance(loader, OxeLoader) else None
        save_policy_config(run, PolicyConfig(experiment.encoding, experiment.model, displacement), tokenizer)
        checkpoints.save_base(frozen)

    targets = number_rows(tokenizer, experiment.encoding.style).targets(experiment.soft_target_sigma)
    train_step = jit_train_step(make_train_step(experiment, model, optimizer, targets), state, mesh)
    first = int(state.step)
    with Metrics(run, first) as metrics, tqdm(total=experiment.steps, initial=first, unit="step", desc="train") as bar:
        for step in range(first, experiment.steps):
            watchdog.doing(f"reading data for step {step}")
            batch = put_batch(next(loader), mesh)
            watchdog.doing(f"computing step {step}")
            if step == first:
                bar.set_postfix_str("compiling the training step")
            state, step_metrics = train_step(state, frozen, batch)
            bar.update()
            done = step + 1
            if done % experiment.log_every == 0 or done == experiment.steps:
                values = {name: float(value) for name, value in step_metrics.items()}
                metrics.write(done, values)
                bar.set_postfix_str(f"loss {values['loss']:.3f}, bins within one {values['bin_within_one']:.2f}")
            if done % experiment.checkpoint_every == 0 or done == experiment.steps:
                checkpoints.save(done, state.trainable, state.optimizer, loader.get_state())
    checkpoints.close()
    print(f"trained: {run} (evaluate it with: python eval.py {run})")


def open_data(experiment: Experiment, tokenizer: Tokenizer, part: BatchPart) -> tuple[Any, int]:
    """The batches of this process, as an iterator with a position to save, and the number of different samples."""
    order: dict[str, Any] = {
        "batch_size": part.size,
        "seed": experiment.seed,
        "process_index": part.index,
        "process_count": part.count,
    }
    if experiment.oxe is not None:
        loader = OxeLoader(experiment.oxe, experiment.encoding, tokenizer, **order)
        return loader, loader.num_samples
    reader = open_demonstrations(experiment.data, tokenizer)
    sample = make_sampler(experiment.data, experiment.encoding, tokenizer)
    return make_loader(reader, sample, **order), reader.num_frames


def tokenizer_of(experiment: Experiment) -> Tokenizer:
    """The vocabulary of the experiment, which has to be that of its language model."""
    tokenizer = load_tokenizer(experiment.tokenizer) if experiment.tokenizer else suite_tokenizer()
    expected = experiment.model.language.vocab_size
    if not tokenizer.vocab_size <= expected < tokenizer.vocab_size + PADDING_ROWS:
        raise UserError(
            f"tokenizer: {experiment.tokenizer or 'the words of the task suite'} has {tokenizer.vocab_size} tokens, "
            f"model.language.vocab_size is {expected}; they must be of one language model"
        )
    return tokenizer


def base_variables(experiment: Experiment, mesh: jax.sharding.Mesh) -> dict[str, Any]:
    """The variables that a base run or imported weights have for the experiment, split over the mesh."""
    if not experiment.base:
        return {}
    folder = Path(experiment.base)
    if is_imported(folder):
        return load_for_model(folder, experiment.model, mesh, frozen=experiment.regime == "lora")
    params = dsvla_jax.policy.load(folder, mesh).variables["params"]
    expected = jax.eval_shape(lambda: initialize(experiment.model, jax.random.key(0)))
    require_same_shapes(params, expected["params"], folder)
    return {"params": params}


def prepare_run_folder(run: Path, experiment: Experiment, resume: bool) -> None:
    """Makes the run folder, or refuses one that holds other work."""
    config = run / "config.json"
    if config.exists():
        if not resume:
            raise CheckpointError(f"{run} already holds a run; go on with --resume, or choose another --run")
        stored = load_experiment(config)
        if stored != experiment:
            fields = [name for name in vars(experiment) if getattr(stored, name) != getattr(experiment, name)]
            raise CheckpointError(
                f"{config}: this run was started with another config ({', '.join(fields)} differ); "
                "resume it with the same one, or choose another --run"
            )
    run.mkdir(parents=True, exist_ok=True)


def report_size(trainable: Any, frozen: Any, samples: int) -> None:
    """Prints what will be trained."""
    learn, rest = (sum(leaf.size for leaf in jax.tree.leaves(tree)) for tree in (trainable, frozen))
    print(f"{learn:,} trainable and {rest:,} frozen parameters; {samples:,} samples")


class Metrics:
    """Writes numbers to metrics.jsonl and to TensorBoard."""

    def __init__(self, run: Path, step: int):
        self._file = (run / "metrics.jsonl").open("a")
        self._board = SummaryWriter(str(run / "tensorboard"), purge_step=step)
        self._clock = (step, time.monotonic())

    def write(self, step: int, values: dict[str, float]) -> None:
        last_step, last_time = self._clock
        self._clock = (step, time.monotonic())
        values = {**values, "seconds_per_step": (self._clock[1] - last_time) / max(step - last_step, 1)}
        self._file.write(json.dumps({"step": step, **values}) + "\n")
        self._file.flush()
        for name, value in values.items():
            self._board.add_scalar(name, value, step)

    def __enter__(self) -> "Metrics":
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()
        self._board.close()


def command_line(arguments: list[str]) -> None:
    """Parses `CONFIG --option value ...` and trains."""
    if not arguments or arguments[0].startswith("-"):
        print(__doc__)
        print("configs:", ", ".join(config_names()))
        sys.exit(0 if arguments else 2)
    name, *rest = arguments
    experiment = get_config(name)
    start_processes()
    configure_jax()

    def train(
        experiment: Annotated[Experiment, tyro.conf.arg(name="")] = experiment,
        run: Path = Path("runs") / name,
        resume: bool = False,
    ) -> None:
        """Trains one experiment.

        Args:
            experiment: what to train; every field of the config can be overridden.
            run: the run folder.
            resume: go on from the newest checkpoint of the run folder; a finished run is left as it is.
        """
        with Watchdog(run / "processes").watching() as watchdog:
            main(experiment, run, resume, watchdog)

    tyro.cli(train, args=rest, prog=f"train.py {name}", config=(tyro.conf.AvoidSubcommands,))


if __name__ == "__main__":
    with fail_with_message():
        command_line(sys.argv[1:])
