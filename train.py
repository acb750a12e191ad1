"""Train 3DS-VLA: python train.py CONFIG [--run DIR] [--steps 500 --optimizer.learning-rate 3e-4 ...]

CONFIG is a name of configs/, or the path of a Python file of your own with a function `config() -> Experiment`.
Demonstrations are generated first where they are missing. The run folder receives the config, the vocabulary,
checkpoints, and metrics (metrics.jsonl and TensorBoard). A run that was stopped, or killed, goes on when the same
command is given again; a finished one is left as it is.
"""

import contextlib
import dataclasses
import itertools
import signal
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import jax
import numpy as np
import tyro

import dsvla_jax.policy
from configs import config_names, get_config
from data_pipelines.first_look import fit_workspace, look_at_demonstrations, look_at_mixture
from data_pipelines.learned_from import learned_from, learned_from_oxe
from data_pipelines.loader import make_loader
from data_pipelines.samples import make_sampler, make_validation_sampler
from data_pipelines.sources import (
    choose_tasks,
    open_demonstrations,
    open_held_out,
    require_data_fits,
    require_oxe_fits,
)
from dsvla_jax.checkpoints.run import RunCheckpoints
from dsvla_jax.checkpoints.steps import has_checkpoints
from dsvla_jax.checkpoints.storage import require_same_shapes, require_writable_path
from dsvla_jax.command_line import configure_jax, fail_with_message, keep_freed_memory, parse_options
from dsvla_jax.encoding.displacement import DisplacementScale
from dsvla_jax.encoding.number_targets import number_rows
from dsvla_jax.encoding.pretrained_tokenizers import fits_rows, load_tokenizer
from dsvla_jax.encoding.text import Tokenizer
from dsvla_jax.errors import UserError
from dsvla_jax.evaluation.loop import Stopped, on_host, run_task
from dsvla_jax.experiment import Experiment, OptimizerConfig, load_experiment, save_experiment
from dsvla_jax.model.partition import make_sharded
from dsvla_jax.model.variables import Variables, join_variables
from dsvla_jax.model.vla import VLA, initialize
from dsvla_jax.perception.simulator import keypoint_source
from dsvla_jax.planner.preflight import check_step
from dsvla_jax.policy import Policy, PolicyConfig, save_policy_config
from dsvla_jax.ranges import require
from dsvla_jax.sim.environment import Environment
from dsvla_jax.sim.tasks import TASKS, select_tasks
from dsvla_jax.suite_vocabulary import suite_tokenizer
from dsvla_jax.training import loop
from dsvla_jax.training.distributed import Watchdog, first_process_first, start_processes
from dsvla_jax.training.metrics import MetricsWriter, require_wandb
from dsvla_jax.training.profile import trace_steps
from dsvla_jax.training.run_folder import only_one_process, remove_other_start, require_same_experiment, run_folder
from dsvla_jax.training.sharding import BatchPart, batch_part, make_mesh, put_batch
from dsvla_jax.training.signals import EXIT_STATUS
from dsvla_jax.training.state import TrainState, initial_state, jit_train_step, make_optimizer, make_train_step
from dsvla_jax.training.validation import jit_validation, mean_errors
from dsvla_jax.types import Example, HeldOutExample
from dsvla_jax.weights.backbones import is_imported, load_for_model, require_base


def prepare(
    experiment: Experiment, run: Path
) -> tuple[Experiment, Tokenizer, jax.sharding.Mesh, BatchPart, tuple[int, int]]:
    """The experiment with the names of its tasks, its vocabulary, the mesh, this process's part of a batch, and height
    and width of the pictures that it learns from. Writes nothing but demonstrations to fit the workspace to.

    Raises UserError, naming the options, where settings contradict one another, the vocabulary, the base, the pictures,
    or what the run folder holds.
    """
    require_writable_path(run)
    tokenizer = tokenizer_of(experiment)
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
        picture = require_data_fits(experiment.data, experiment.encoding, tokenizer, held_out)
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
    batches, samples, displacement = open_data(experiment, tokenizer, part)
    held_out = open_validation(experiment, tokenizer, part)
    optimizer = make_optimizer(experiment.optimizer, experiment.steps)
    start = partial(initial_state, experiment, tokenizer.number_values, optimizer)
    state, frozen = make_sharded(start, mesh, base_variables(experiment, mesh))
    report_size(state.trainable, frozen, samples)

    save_experiment(run / "config.json", experiment)
    if experiment.oxe is None:
        learned = learned_from(experiment.data, experiment.encoding.use_keypoints)
    else:
        learned = learned_from_oxe(experiment.oxe, [len(item.dataset.arms) for item in batches.source.datasets])
    save_policy_config(run, PolicyConfig(experiment.encoding, experiment.model, displacement, learned), tokenizer)
    if checkpoints.latest_step is not None:
        frozen = checkpoints.restore_base(frozen)
        restored = checkpoints.restore(loop.arrays_of(state))
        state = loop.state_of(restored)
        batches.set_state(restored.notes.iterator)
        print(f"resuming {run} at step {restored.step}")
    else:
        checkpoints.save_base(frozen)

    targets = number_rows(tokenizer, experiment.encoding.style).targets(experiment.soft_target_sigma)
    compiled = jit_train_step(make_train_step(experiment, VLA(experiment.model), optimizer, targets), state, mesh)

    def step(state: TrainState, batch: Example[np.ndarray]) -> tuple[TrainState, dict[str, Any]]:
        return compiled(state, frozen, put_batch(batch, mesh))

    sums = jit_validation(experiment, targets, mesh)

    def validate(state: TrainState, _: Callable[[], bool]) -> dict[str, float]:
        return mean_errors(sums, state.trainable, frozen, held_out(), mesh)

    checks = (
        loop.PeriodicEval("validating", experiment.validate_every, validate),
        loop.PeriodicEval("evaluating", experiment.evaluate_every, make_evaluation(experiment, tokenizer, frozen)),
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
            batches=batches,
            checkpoints=checkpoints,
            metrics=metrics,
            checks=checks,
            note=watchdog.doing,
        )


def open_data(
    experiment: Experiment, tokenizer: Tokenizer, part: BatchPart
) -> tuple[Any, int, DisplacementScale | None]:
    """The batches of this process, as an iterator with a position to save; the number of different samples; and what
    displacements are binned over, where the targets are such.
    """
    order: dict[str, Any] = {
        "batch_size": part.size,
        "seed": experiment.seed,
        "process_index": part.index,
        "process_count": part.count,
    }
    if experiment.oxe is not None:
        # Its feature definitions take a second to import, which no other run needs.
        from data_pipelines.oxe.loader import OxeLoader

        loader = OxeLoader(experiment.oxe, experiment.encoding, tokenizer, **order)
        print(*look_at_mixture(loader.source.datasets, experiment.encoding), sep="\n")
        return loader, loader.num_samples, loader.scale
    with first_process_first("demonstrations"):
        reader = open_demonstrations(experiment.data, tokenizer)
    print(look_at_demonstrations(reader, experiment.encoding))
    sample = make_sampler(experiment.data, experiment.encoding, tokenizer)
    return make_loader(reader, sample, **order), reader.num_frames, None


def open_validation(
    experiment: Experiment, tokenizer: Tokenizer, part: BatchPart
) -> Callable[[], Iterator[HeldOutExample[np.ndarray]]]:
    """This process's parts of the batches to validate with, from their beginning each time: never training's stream.
    None where nothing is validated."""
    if not experiment.validate_every:
        return lambda: iter(())
    with first_process_first("held-out demonstrations"):
        reader = open_held_out(experiment.data, tokenizer, experiment.validation.episodes)
    sample = make_validation_sampler(experiment.data, experiment.encoding, tokenizer)
    # A pass forward over the part of a batch that is trained on at a time fits where training does.
    size = part.size // experiment.gradient_accumulation
    count = min(experiment.validation.batches, max(reader.num_frames // (size * part.count), 1))
    order: dict[str, Any] = {"seed": experiment.seed, "process_index": part.index, "process_count": part.count}

    def batches() -> Iterator[HeldOutExample[np.ndarray]]:
        return itertools.islice(make_loader(reader, sample, batch_size=size, num_threads=0, **order), count)

    return batches


def make_evaluation(
    experiment: Experiment, tokenizer: Tokenizer, frozen: Variables
) -> Callable[[TrainState, Callable[[], bool]], dict[str, float]]:
    """Success rates of the present weights on the training tasks, from seeds that neither training nor eval.py has."""
    environments: dict[str, Environment] = {}

    def evaluate(state: TrainState, stop: Callable[[], bool]) -> dict[str, float]:
        config = PolicyConfig(experiment.encoding, experiment.model)
        policy = Policy(config, join_variables(state.trainable, frozen), tokenizer)
        rates: dict[str, float] = {}
        for name in experiment.data.tasks:
            if name not in environments:
                environments[name] = Environment(name, image_size=experiment.data.image_size)
            try:
                endings = run_task(
                    environments[name],
                    on_host(environments[name], policy.act),
                    experiment.evaluation.episodes_while_training,
                    split="validation",
                    seed=experiment.data.seed,
                    find_keypoints=keypoint_source(experiment.keypoints, environments[name]),
                    stop=stop,
                )
            except Stopped:
                return {}
            rates[f"evaluation/{name}"] = float(np.mean([ending.success for ending in endings]))
        return {**rates, "evaluation/success": float(np.mean(list(rates.values())))}

    return evaluate


def require_possible(experiment: Experiment) -> None:
    """Raises UserError where training cannot be scheduled or watched as asked for."""
    warmup = experiment.optimizer.warmup_steps
    # The default suits every run, because warm-up is a fifth of it at most.
    if warmup > experiment.steps and warmup != OptimizerConfig().warmup_steps:
        raise UserError(f"optimizer.warmup_steps: expected at most steps ({experiment.steps}), got {warmup}")
    if experiment.evaluate_every:
        if experiment.oxe is not None:
            raise UserError("evaluate_every: the simulator has no tasks of Open X-Embodiment; set it to 0")
        if jax.process_count() > 1:
            raise UserError(
                f"evaluate_every: episodes run in one process, and this job has {jax.process_count()}, none of which "
                "holds all weights; set it to 0, use --validate-every, and evaluate checkpoints beside the job: python "
                "eval.py RUN"
            )
        select_tasks(experiment.data.tasks)
        size = experiment.data.image_size
        experiment.encoding.require_points(size, size, "a picture of data.image_size")
    if experiment.validate_every and experiment.oxe is not None:
        raise UserError(
            "validate_every: nothing is held out of Open X-Embodiment mixtures, whose displacements are binned over "
            "what training learns from; set it to 0, and judge the run by what is finetuned from it"
        )


def with_workspace(experiment: Experiment, run: Path, tokenizer: Tokenizer) -> Experiment:
    """The experiment with the workspace that its run or else its data have, where that is to be fitted."""
    if not (experiment.fit_workspace and experiment.encoding.use_points):
        return experiment
    config = run / "config.json"
    if config.exists() and has_checkpoints(run):
        known = load_experiment(config).encoding
        box = {"workspace_low": known.workspace_low, "workspace_high": known.workspace_high}
        return dataclasses.replace(experiment, encoding=dataclasses.replace(experiment.encoding, **box))
    with first_process_first("demonstrations"):
        encoding = fit_workspace(experiment.data, experiment.oxe, experiment.encoding, tokenizer)
    print(f"workspace fitted: from {encoding.workspace_low} to {encoding.workspace_high}")
    return dataclasses.replace(experiment, encoding=encoding)


def tokenizer_of(experiment: Experiment) -> Tokenizer:
    """The vocabulary of the experiment, which has to be that of its language model."""
    tokenizer = load_tokenizer(experiment.tokenizer) if experiment.tokenizer else suite_tokenizer()
    expected = experiment.model.language.vocab_size
    if not fits_rows(tokenizer, expected):
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
        return load_for_model(folder, experiment.model, mesh, frozen=experiment.regime != "full")
    policy = dsvla_jax.policy.load_policy(folder, mesh)
    if policy.tokenizer != tokenizer_of(experiment):
        raise UserError(
            f"base: {folder} was trained with another vocabulary, whose tokens its embedding stands for; train with "
            f"that one: --tokenizer {folder}"
        )
    params = policy.variables["params"]
    expected = jax.eval_shape(lambda: initialize(experiment.model, jax.random.key(0)))
    require_same_shapes(params, expected["params"], folder)
    return {"params": params}


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
