"""What training can be scheduled and watched with."""

import jax

from dsvla_jax.errors import UserError
from dsvla_jax.experiment import Experiment, OptimizerConfig
from dsvla_jax.model.attention import has_cudnn
from dsvla_jax.sim.cameras import check_cameras
from dsvla_jax.sim.tasks import get_task, select_tasks


def require_possible(experiment: Experiment) -> None:
    """Raises UserError where training cannot be scheduled or watched as asked for."""
    warmup = experiment.optimizer.warmup_steps
    # The default suits every run, because warm-up is a fifth of it at most.
    if warmup > experiment.steps and warmup != OptimizerConfig().warmup_steps:
        raise UserError(f"optimizer.warmup_steps: expected at most steps ({experiment.steps}), got {warmup}")
    if experiment.model.attention == "cudnn" and not has_cudnn():
        raise UserError(
            f"model.attention: 'cudnn' is a kernel of NVIDIA's GPUs, and JAX has {jax.default_backend()} here; use auto"
        )
    if experiment.baseline is not None and experiment.oxe is not None:
        raise UserError("baseline: Open X-Embodiment mixtures are written as 3DS-VLA's text; leave one of the two out")
    if experiment.evaluate_every:
        if experiment.oxe is not None:
            raise UserError("evaluate_every: the simulator has no tasks of Open X-Embodiment; set it to 0")
        if jax.process_count() > 1:
            raise UserError(
                f"evaluate_every: episodes run in one process, and this job has {jax.process_count()}, none of which "
                "holds all weights; set it to 0, use --validate-every, and evaluate checkpoints beside the job: python "
                "eval.py RUN"
            )
        for task in select_tasks(experiment.data.tasks):
            check_cameras(experiment.data.cameras, get_task(task).num_arms)
        size = experiment.data.image_size
        experiment.encoding.require_points(size, size, experiment.model.cameras, "a picture of data.image_size")
    if experiment.validate_every and experiment.oxe is not None:
        raise UserError(
            "validate_every: nothing is held out of Open X-Embodiment mixtures, whose displacements are binned over "
            "what training learns from; set it to 0, and judge the run by what is finetuned from it"
        )
