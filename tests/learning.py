"""3DS-VLA's training step and state of an experiment, with the tokenizer's part given."""

from typing import Any

import numpy as np
import optax

from dsvla_jax.encoding.number_targets import NumberTargets
from dsvla_jax.experiment import Experiment
from dsvla_jax.model.variables import Variables
from dsvla_jax.policies.three_ds_vla import TextLearner
from dsvla_jax.training.state import TrainState, TrainStep, initial_state, make_train_step

NO_NUMBERS = NumberTargets(
    tokens=np.zeros(1, np.int32),
    offsets=np.full((1, 1), np.inf, np.float32),
    weights=None,
    begins=np.zeros(1, bool),
)


def learner_of(
    experiment: Experiment, targets: NumberTargets = NO_NUMBERS, number_values: np.ndarray | None = None
) -> TextLearner:
    """How the experiment's policy learns."""
    return TextLearner(experiment.encoding, experiment.model, targets, number_values)


def start_of(
    experiment: Experiment,
    number_values: np.ndarray | None,
    optimizer: optax.GradientTransformation,
    base: Variables | None = None,
) -> tuple[TrainState, Variables]:
    """State and frozen variables at step 0."""
    learner = learner_of(experiment, number_values=number_values)
    return initial_state(
        learner, optimizer, experiment.seed, experiment.regime, experiment.model.frozen_dtype, base=base
    )


def step_of(experiment: Experiment, optimizer: optax.GradientTransformation, targets: NumberTargets) -> TrainStep[Any]:
    """The training step."""
    return make_train_step(learner_of(experiment, targets), optimizer, experiment.gradient_accumulation)
