"""Train a policy: python train.py CONFIG [--run DIR] [--steps 500 --optimizer.learning-rate 3e-4 ...]

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
from functools import partial
from pathlib import Path
from typing import Annotated

import jax
import tyro

from configs import config_names, get_config
from data_pipelines.preparation import Prepared, prepare
from data_pipelines.training_data import open_training_data, open_validation_data
from dsvla_jax.checkpoints.run import RunCheckpoints
from dsvla_jax.command_line import configure_jax, fail_with_message, keep_freed_memory, parse_options
from dsvla_jax.evaluation.while_training import measure_success
from dsvla_jax.experiment import Experiment, save_experiment
from dsvla_jax.model.partition import make_sharded
from dsvla_jax.model.variables import Variables, join_variables
from dsvla_jax.planner.preflight import check_step
from dsvla_jax.policies.interface import Metrics
from dsvla_jax.policies.registry import make_learner, make_policy
from dsvla_jax.policy import save_policy_config
from dsvla_jax.ranges import require
from dsvla_jax.sim.tasks import TASKS
from dsvla_jax.training import loop
from dsvla_jax.training.distributed import Watchdog, start_processes
from dsvla_jax.training.metrics import MetricsWriter, require_wandb
from dsvla_jax.training.profile import trace_steps
from dsvla_jax.training.run_folder import only_one_process, remove_other_start, run_folder
from dsvla_jax.training.sharding import put_batch
from dsvla_jax.training.signals import EXIT_STATUS
from dsvla_jax.training.state import TrainState, initial_state, jit_train_step, make_optimizer, make_train_step
from dsvla_jax.training.validation import jit_validation, mean_errors
from dsvla_jax.weights.base_variables import base_variables


def main(experiment: Experiment, run: Path, watchdog: Watchdog, wandb: str = "", profile: int = 0) -> int:
    """Trains one experiment into the run folder, or goes on from its newest checkpoint. Returns the exit status."""
    require(profile >= 0, "profile", "at least 0", profile)
    if wandb:
        require_wandb()
    prepared = prepare(experiment, run)
    experiment = prepared.experiment
    check_step(experiment, prepared.mesh, prepared.picture)
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
        stopped = train(prepared, run, checkpoints, watchdog, wandb, profile)
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
    prepared: Prepared, run: Path, checkpoints: RunCheckpoints, watchdog: Watchdog, wandb: str, profile: int
) -> signal.Signals | None:
    """Trains from the newest checkpoint, or from the beginning. Returns the signal that stopped it, if one did."""
    experiment, tokenizer, mesh = prepared.experiment, prepared.tokenizer, prepared.mesh
    data = open_training_data(experiment, tokenizer, prepared.part)
    held_out = open_validation_data(experiment, tokenizer, prepared.part)
    optimizer = make_optimizer(experiment.optimizer, experiment.steps)
    config = dataclasses.replace(
        experiment.policy,
        displacement=data.displacement,
        vector_scale=data.vector_scale,
        learned_from=data.learned_from,
    )
    learner = make_learner(config, tokenizer, experiment.soft_target_sigma, experiment.num_cameras)
    average, regime, model = experiment.optimizer.average_decay, experiment.regime, experiment.model
    start = partial(initial_state, learner, optimizer, experiment.seed, regime, model.frozen_dtype, average > 0)
    base = base_variables(experiment.base, model, tokenizer, regime != "full", mesh)
    state, frozen = make_sharded(start, mesh, base)
    report_size(state.trainable, frozen, data.samples)

    save_experiment(run / "config.json", experiment)
    save_policy_config(run, config, tokenizer)
    state, frozen = loop.resume(checkpoints, state, frozen, data.batches)
    if state.step:
        print(f"resuming {run} at step {int(state.step)}")

    train_step = make_train_step(learner, optimizer, experiment.gradient_accumulation, average)
    compiled = jit_train_step(train_step, state, mesh)

    def step(state: TrainState, batch: object) -> tuple[TrainState, Metrics]:
        return compiled(state, frozen, put_batch(batch, mesh))

    sums = jit_validation(learner, mesh)

    def validate(state: TrainState, _: Callable[[], bool]) -> dict[str, float]:
        return mean_errors(sums, state.acting, frozen, held_out(), mesh)

    def evaluate(state: TrainState, stop: Callable[[], bool]) -> dict[str, float]:
        policy = make_policy(config, join_variables(state.acting, frozen), tokenizer)
        episodes = experiment.evaluation.episodes_while_training
        return measure_success(policy.act, experiment.data, experiment.keypoints, episodes, stop)

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
            regime=regime,
            state=state,
            step=traced,
            batches=data.batches,
            checkpoints=checkpoints,
            metrics=metrics,
            learner=learner,
            checks=checks,
            note=watchdog.doing,
        )


def report_size(trainable: Variables, frozen: Variables, samples: int) -> None:
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
