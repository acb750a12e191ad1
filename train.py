"""Train 3DS-VLA: python train.py CONFIG [--run DIR] [--steps 500 --optimizer.learning-rate 3e-4 ...]

CONFIG is a name of configs/, or the path of a Python file of your own with a function `config() -> Experiment`.
Demonstrations are generated first where they are missing. The run folder receives the config, the vocabulary,
checkpoints, and metrics (metrics.jsonl and TensorBoard). A run that was stopped, or killed, goes on when the same
command is given again; a finished one is left as it is.
"""

import contextlib
import dataclasses
import signal
import sys
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Annotated, Any

import jax
import tyro

from configs import config_names, get_config
from data_pipelines.sources import (
    choose_tasks,
    require_data_fits,
    require_oxe_fits,
)
from data_pipelines.training_data import open_training_data, open_validation_data, with_workspace
from dsvla_jax.checkpoints.run import RunCheckpoints
from dsvla_jax.checkpoints.storage import require_writable_path
from dsvla_jax.command_line import configure_jax, fail_with_message, keep_freed_memory, parse_options
from dsvla_jax.encoding.text import Tokenizer
from dsvla_jax.evaluation.while_training import measure_success
from dsvla_jax.experiment import Experiment, save_experiment
from dsvla_jax.model.partition import make_sharded
from dsvla_jax.model.variables import join_variables
from dsvla_jax.planner.preflight import check_step
from dsvla_jax.policies.config import PolicyConfig, uses_model
from dsvla_jax.policies.registry import make_learner, make_policy
from dsvla_jax.policy import save_policy_config
from dsvla_jax.ranges import require
from dsvla_jax.sim.environment import Environment
from dsvla_jax.sim.tasks import TASKS
from dsvla_jax.suite_vocabulary import tokenizer_of
from dsvla_jax.training import loop
from dsvla_jax.training.distributed import Watchdog, start_processes
from dsvla_jax.training.metrics import MetricsWriter, require_wandb
from dsvla_jax.training.possible import require_possible
from dsvla_jax.training.profile import trace_steps
from dsvla_jax.training.run_folder import only_one_process, remove_other_start, require_same_experiment, run_folder
from dsvla_jax.training.sharding import BatchPart, batch_part, make_mesh, put_batch
from dsvla_jax.training.signals import EXIT_STATUS
from dsvla_jax.training.state import TrainState, initial_state, jit_train_step, make_optimizer, make_train_step
from dsvla_jax.training.validation import jit_validation, mean_errors
from dsvla_jax.weights.backbones import require_base
from dsvla_jax.weights.base_variables import base_variables


def prepare(
    experiment: Experiment, run: Path
) -> tuple[Experiment, Tokenizer, jax.sharding.Mesh, BatchPart, tuple[int, int]]:
    """Completes and checks an experiment. Writes nothing but demonstrations to fit the workspace to.

    Returns the experiment with the names of its tasks, its vocabulary, the mesh, this process's part of a batch, and
    height and width of the pictures that it learns from. Raises UserError, naming the options, if settings contradict
    one another, the vocabulary, the base, the pictures, or what the run folder holds.
    """
    require_writable_path(run)
    rows = experiment.model.language.vocab_size if uses_model(experiment.baseline) else None
    tokenizer = tokenizer_of(experiment.tokenizer, rows)
    if experiment.oxe is None:
        tasks = choose_tasks(experiment.data)
        experiment = dataclasses.replace(experiment, data=dataclasses.replace(experiment.data, tasks=tasks))
    require_possible(experiment)
    mesh = make_mesh(experiment.mesh)
    part = batch_part(mesh, experiment.batch_size, experiment.gradient_accumulation)
    if experiment.base:
        require_base(Path(experiment.base), experiment.model)
    held_out = experiment.validation.episodes if experiment.validate_every else 0
    if experiment.oxe is not None:
        picture = require_oxe_fits(experiment.oxe, experiment.encoding, tokenizer)
    else:
        picture = require_data_fits(
            experiment.data, experiment.encoding, tokenizer, held_out, instructions_only=experiment.baseline is not None
        )
    experiment = with_workspace(experiment, run, tokenizer)
    require_same_experiment(run, experiment)
    return experiment, tokenizer, mesh, part, picture


def main(experiment: Experiment, run: Path, watchdog: Watchdog, wandb: str = "", profile: int = 0) -> int:
    """Trains one experiment into the run folder, or goes on from its newest checkpoint. Returns the exit status."""
    require(profile >= 0, "profile", "at least 0", profile)
    if wandb:
        require_wandb()
    experiment, tokenizer, mesh, part, picture = prepare(experiment, run)
    check_step(experiment, mesh, picture)
    with (
        run_folder(run),
        only_one_process(run),
        contextlib.closing(RunCheckpoints(run, keep=experiment.keep_checkpoints)) as checkpoints,
    ):
        if checkpoints.latest_step == experiment.steps:
            print(f"{run} has been trained to step {experiment.steps}: nothing to do")
            return 0
        if checkpoints.latest_step is None:
            remove_other_start(run, experiment)
        stopped = train(experiment, run, tokenizer, checkpoints, mesh, part, watchdog, wandb, profile)
        step_reached = checkpoints.latest_step
    if stopped is not None:
        print(f"{stopped.name}: {run} is saved at step {step_reached}; the same command goes on from there")
        return EXIT_STATUS[stopped]
    print(f"trained: {run} ({advice(experiment)} {run})")
    return 0


def advice(experiment: Experiment) -> str:
    """What to do with a finished run: words that the run's folder follows."""
    if experiment.oxe is not None:
        return "finetune it in simulation with: python train.py CONFIG --base"
    # The simulator does not have the tasks of one's own demonstrations.
    simulated = set(experiment.data.tasks) <= TASKS.keys()
    return "evaluate it with: python eval.py" if simulated else "serve it with: python -m dsvla_jax.serving"


def train(
    experiment: Experiment,
    run: Path,
    tokenizer: Tokenizer,
    checkpoints: RunCheckpoints,
    mesh: jax.sharding.Mesh,
    part: BatchPart,
    watchdog: Watchdog,
    wandb: str,
    profile: int,
) -> signal.Signals | None:
    """Trains from the newest checkpoint, or from the beginning. Returns the signal that stopped it, if one did."""
    data = open_training_data(experiment, tokenizer, part)
    held_out = open_validation_data(experiment, tokenizer, part)
    optimizer = make_optimizer(experiment.optimizer, experiment.steps)
    learner = make_learner(
        experiment.baseline,
        experiment.encoding,
        experiment.model,
        tokenizer,
        experiment.soft_target_sigma,
        experiment.num_cameras,
    )
    average = experiment.optimizer.average_decay
    start = partial(
        initial_state,
        learner,
        optimizer,
        experiment.seed,
        experiment.regime,
        experiment.model.frozen_dtype,
        average > 0,
    )
    base = base_variables(experiment.base, experiment.model, tokenizer, experiment.regime != "full", mesh)
    state, frozen = make_sharded(start, mesh, base)
    report_size(state.trainable, frozen, data.samples)

    save_experiment(run / "config.json", experiment)
    config = PolicyConfig(
        experiment.encoding, experiment.model, data.displacement, data.learned_from, baseline=experiment.baseline
    )
    save_policy_config(run, config, tokenizer)
    if checkpoints.latest_step is not None:
        frozen = checkpoints.restore_base(frozen)
        restored = checkpoints.restore(loop.arrays_of(state))
        state = loop.state_of(restored)
        data.batches.set_state(restored.notes.iterator)
        print(f"resuming {run} at step {restored.step}")
    else:
        checkpoints.save_base(frozen)

    train_step = make_train_step(learner, optimizer, experiment.gradient_accumulation, average)
    compiled = jit_train_step(train_step, state, mesh)

    def step(state: TrainState, batch: Any) -> tuple[TrainState, dict[str, Any]]:
        return compiled(state, frozen, put_batch(batch, mesh))

    sums = jit_validation(learner, mesh)

    def validate(state: TrainState, _: Callable[[], bool]) -> dict[str, float]:
        return mean_errors(sums, state.acting, frozen, held_out(), mesh)

    def simulate(task: str) -> Environment:
        return Environment(task, image_size=experiment.data.image_size, cameras=experiment.data.cameras)

    @cache
    def environments() -> dict[str, Environment]:
        return {name: simulate(name) for name in experiment.data.tasks}

    def evaluate(state: TrainState, stop: Callable[[], bool]) -> dict[str, float]:
        policy = make_policy(config, join_variables(state.acting, frozen), tokenizer)
        episodes = experiment.evaluation.episodes_while_training
        return measure_success(policy.act, environments(), experiment.keypoints, episodes, experiment.data.seed, stop)

    checks = (
        loop.PeriodicEval("validating", experiment.validate_every, validate),
        loop.PeriodicEval("evaluating", experiment.evaluate_every, evaluate),
    )
    with (
        MetricsWriter(run, int(state.step), wandb, dataclasses.asdict(experiment)) as metrics,
        trace_steps(step, run / "profile", profile) as traced,
    ):
        return loop.train(
            experiment,
            run,
            state=state,
            step=traced,
            batches=data.batches,
            checkpoints=checkpoints,
            metrics=metrics,
            learner=learner,
            checks=checks,
            note=watchdog.doing,
        )


def report_size(trainable: Any, frozen: Any, samples: int) -> None:
    """Prints what will be trained."""
    learn, rest = (sum(leaf.size for leaf in jax.tree.leaves(tree)) for tree in (trainable, frozen))
    print(f"{learn:,} trainable and {rest:,} frozen parameters; {samples:,} samples")


def command_line(arguments: list[str]) -> None:
    """Parses `CONFIG --option value ...` and trains."""
    if not arguments or arguments[0].startswith("-"):
        print(__doc__)
        print("configs:", ", ".join(config_names()))
        sys.exit(0 if arguments else 2)
    name, *rest = arguments
    experiment = get_config(name)
    keep_freed_memory()
    start_processes()
    configure_jax()

    def chosen(
        experiment: Annotated[Experiment, tyro.conf.arg(name="")] = experiment,
        run: Path = Path("runs") / Path(name).stem,
        wandb: str = "",
        profile: int = 0,
    ) -> tuple[Experiment, Path, str, int]:
        """Trains one experiment.

        Args:
            experiment: what to train; every field of the config can be overridden.
            run: the run folder; one that holds a run of the same config goes on from its newest checkpoint.
            wandb: the project of Weights & Biases to write metrics to as well.
            profile: how many steps to trace into the run folder's `profile`, from the third step on.
        """
        return experiment, run, wandb, profile

    options = {"args": rest, "prog": f"train.py {name}", "config": (tyro.conf.AvoidSubcommands,)}
    experiment, run, wandb, profile = parse_options(chosen, **options)
    with Watchdog(run / "processes").watching() as watchdog:
        status = main(experiment, run, watchdog, wandb, profile)
    sys.exit(status)


def program() -> None:
    """Runs the program: `python train.py`, or `dsvla-train` where the project is installed."""
    with fail_with_message():
        command_line(sys.argv[1:])


if __name__ == "__main__":
    program()
