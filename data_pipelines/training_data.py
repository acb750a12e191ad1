"""What a run trains on and is validated with: batches of demonstrations, or of Open X-Embodiment episodes."""

import dataclasses
import itertools
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypedDict, TypeVar

import jax.numpy as jnp
import numpy as np

from data_pipelines.episodes import EpisodeReader
from data_pipelines.first_look import fit_workspace, look_at_demonstrations, look_at_mixture
from data_pipelines.learned_from import learned_from, learned_from_oxe
from data_pipelines.loader import make_loader
from data_pipelines.pose_samples import make_pose_sampler
from data_pipelines.records import Frame
from data_pipelines.samples import make_sampler, make_validation_sampler, without_variation
from data_pipelines.sources import open_demonstrations, open_held_out
from dsvla_jax.checkpoints.steps import has_checkpoints
from dsvla_jax.data_config import DataConfig, LearnedFrom
from dsvla_jax.encoding.codec import PoseCodec
from dsvla_jax.encoding.displacement import DisplacementScale
from dsvla_jax.encoding.text import Tokenizer
from dsvla_jax.encoding.vector_scale import VectorScale, fit_vector_scale
from dsvla_jax.experiment import Experiment, load_experiment
from dsvla_jax.policies.pose_vectors import to_vectors
from dsvla_jax.training.distributed import first_process_first
from dsvla_jax.training.loop import Batches
from dsvla_jax.training.sharding import BatchPart
from dsvla_jax.types import Example, HeldOutExample, PoseExample

# Frames that the range of vectors is taken from: a few seconds of reading.
SCALE_FRAMES = 4000


@dataclasses.dataclass(frozen=True)
class TrainingData:
    """What a run trains on."""

    batches: Batches
    """This process's parts of the batches."""
    samples: int
    """How many different samples there are."""
    learned_from: LearnedFrom
    displacement: DisplacementScale | None = None
    """What displacements are binned over, if the targets are such."""
    vector_scale: VectorScale | None = None
    """What the answers of a baseline with `normalise` "data" are stretched from."""


class _Order(TypedDict):
    seed: int
    process_index: int
    process_count: int


def open_training_data(experiment: Experiment, tokenizer: Tokenizer, part: BatchPart) -> TrainingData:
    """Opens the data of an experiment, which generates what is missing of simulated demonstrations, and looks at it.

    part: of every batch, that of this process. Prints what it found. Raises UserError or DataError for data that cannot
    be learned from.
    """
    encoding, oxe = experiment.encoding, experiment.oxe
    order = _order(experiment, part)
    if oxe is not None:
        # Its feature definitions take a second to import, which no other run needs.
        from data_pipelines.oxe.loader import OxeLoader

        loader = OxeLoader(oxe, encoding, tokenizer, batch_size=part.size, **order)
        print(*look_at_mixture(loader.source.datasets, encoding), sep="\n")
        learned = learned_from_oxe(oxe, [len(item.dataset.arms) for item in loader.source.datasets])
        return TrainingData(loader, loader.num_samples, learned, displacement=loader.scale)
    with first_process_first("demonstrations"):
        reader = open_demonstrations(experiment.data, tokenizer)
    print(look_at_demonstrations(reader, encoding))
    batches = make_loader(reader, training_sampler(experiment, tokenizer), batch_size=part.size, **order)
    scale = None
    if experiment.baseline is not None and experiment.baseline.normalise == "data":
        scale = fit_to_demonstrations(reader, _pose_sampler(experiment, experiment.data, tokenizer), encoding.codec)
    learned = learned_from(experiment.data, encoding.use_keypoints)
    return TrainingData(batches, reader.num_frames, learned, vector_scale=scale)


Sample = TypeVar("Sample")
Sampler = Callable[[Frame, np.random.Generator], Sample]


def training_sampler(
    experiment: Experiment, tokenizer: Tokenizer
) -> Sampler[Example[np.ndarray]] | Sampler[PoseExample[np.ndarray]]:
    """What makes an example of a frame, as the experiment's policy learns from it."""
    if experiment.baseline is None:
        return make_sampler(experiment.data, experiment.encoding, tokenizer)
    return _pose_sampler(experiment, experiment.data, tokenizer)


def validation_sampler(
    experiment: Experiment, tokenizer: Tokenizer
) -> Sampler[HeldOutExample[np.ndarray]] | Sampler[PoseExample[np.ndarray]]:
    """What makes a validation example of a frame, as it was recorded."""
    if experiment.baseline is None:
        return make_validation_sampler(experiment.data, experiment.encoding, tokenizer)
    return _pose_sampler(experiment, without_variation(experiment.data), tokenizer)


def _pose_sampler(experiment: Experiment, data: DataConfig, tokenizer: Tokenizer) -> Sampler[PoseExample[np.ndarray]]:
    assert experiment.baseline is not None
    encoding = experiment.encoding
    return make_pose_sampler(
        data, tokenizer, encoding.max_text_length, encoding.use_keypoints, experiment.baseline.upcoming
    )


def fit_to_demonstrations(
    reader: EpisodeReader, sample: Sampler[PoseExample[np.ndarray]], codec: PoseCodec
) -> VectorScale:
    """The range of the vectors of keyframes that follow, over frames of all episodes, varied as in training."""
    rng = np.random.default_rng(0)
    numbers = np.linspace(0, reader.num_frames - 1, min(reader.num_frames, SCALE_FRAMES)).astype(int)
    poses, grippers, origins = [], [], []
    for number in numbers:
        one = sample(reader.frame(int(number)), rng)
        there = one.inputs.arms
        poses.append(one.pose[:, there].reshape(-1, 7))
        grippers.append(one.gripper_open[:, there].reshape(-1))
        origins.append(np.tile(one.inputs.robot.pose[there, :3], (len(one.pose), 1)))
    pose, gripper_open, origin = (jnp.asarray(np.concatenate(rows)) for rows in (poses, grippers, origins))
    return fit_vector_scale(np.asarray(to_vectors(pose, gripper_open, origin, codec)))


def open_validation_data(
    experiment: Experiment, tokenizer: Tokenizer, part: BatchPart
) -> Callable[[], Iterator[HeldOutExample[np.ndarray] | PoseExample[np.ndarray]]]:
    """Opens the demonstrations held out of training.

    Returns a function that starts again from the first batch: this process's parts of all batches, the same each time;
    none if nothing is validated.
    """
    if not experiment.validate_every:
        return lambda: iter(())
    with first_process_first("held-out demonstrations"):
        reader = open_held_out(experiment.data, tokenizer, experiment.validation.episodes)
    sample = validation_sampler(experiment, tokenizer)
    # A pass forward over the part of a batch that is trained on at a time fits where training does.
    size = part.size // experiment.gradient_accumulation
    count = min(experiment.validation.batches, max(reader.num_frames // (size * part.count), 1))
    order = _order(experiment, part)

    def batches() -> Iterator[HeldOutExample[np.ndarray] | PoseExample[np.ndarray]]:
        return itertools.islice(make_loader(reader, sample, batch_size=size, num_threads=0, **order), count)

    return batches


def with_workspace(experiment: Experiment, run: Path, tokenizer: Tokenizer) -> Experiment:
    """Returns the experiment with the workspace of its run, or else fitted to its data, if it is to be fitted."""
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


def _order(experiment: Experiment, part: BatchPart) -> _Order:
    return {"seed": experiment.seed, "process_index": part.index, "process_count": part.count}
