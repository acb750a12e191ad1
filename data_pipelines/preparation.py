"""What is asked of an experiment before anything of its run is written."""

import dataclasses
from pathlib import Path

from jax.sharding import Mesh

from data_pipelines.sources import choose_tasks, require_data_fits, require_oxe_fits, require_tasks_fit
from data_pipelines.training_data import with_workspace
from dsvla_jax.checkpoints.storage import require_writable_path
from dsvla_jax.encoding.text import Tokenizer
from dsvla_jax.experiment import Experiment
from dsvla_jax.policies.config import uses_model
from dsvla_jax.sim.tasks import TASKS
from dsvla_jax.suite_vocabulary import tokenizer_of
from dsvla_jax.training.possible import require_possible
from dsvla_jax.training.run_folder import require_same_experiment
from dsvla_jax.training.sharding import BatchPart, batch_part, make_mesh
from dsvla_jax.weights.backbones import require_base


@dataclasses.dataclass(frozen=True)
class Prepared:
    """An experiment that can be trained, and what was read or made to find that out."""

    experiment: Experiment
    """With the names of its tasks, and its workspace."""
    tokenizer: Tokenizer
    mesh: Mesh
    part: BatchPart
    """Of every batch, that of this process."""
    picture: tuple[int, int]
    """Height and width of the pictures that it learns from."""


def prepare(experiment: Experiment, run: Path) -> Prepared:
    """Completes and checks an experiment. Writes nothing but demonstrations to fit the workspace to.

    Raises UserError, naming the options, if settings contradict one another, the vocabulary, the base, the pictures, or
    what the run folder holds.
    """
    require_writable_path(run)
    rows = experiment.model.language.vocab_size if uses_model(experiment.baseline) else None
    tokenizer = tokenizer_of(experiment.tokenizer, rows)
    if experiment.oxe is None:
        tasks = choose_tasks(experiment.data)
        experiment = dataclasses.replace(experiment, data=dataclasses.replace(experiment.data, tasks=tasks))
    require_possible(experiment)
    instructions_only = experiment.baseline is not None
    mesh = make_mesh(experiment.mesh)
    part = batch_part(mesh, experiment.batch_size, experiment.gradient_accumulation)
    if experiment.base:
        require_base(Path(experiment.base), experiment.model)
    held_out = experiment.validation.episodes if experiment.validate_every else 0
    if experiment.oxe is not None:
        picture = require_oxe_fits(experiment.oxe, experiment.encoding, tokenizer)
    else:
        picture = require_data_fits(experiment.data, experiment.encoding, tokenizer, held_out, instructions_only)
    # Demonstrations of the simulator have been checked with the same instructions.
    if experiment.evaluate_every and experiment.data.source != "simulator":
        acted = [TASKS[task] for task in experiment.data.tasks]
        or_else = ", or do not act there while training (--evaluate-every 0)"
        require_tasks_fit(acted, experiment.encoding, tokenizer, instructions_only, or_else)
    experiment = with_workspace(experiment, run, tokenizer)
    require_same_experiment(run, experiment)
    return Prepared(experiment, tokenizer, mesh, part, picture)
