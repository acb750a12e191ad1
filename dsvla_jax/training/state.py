"""The training step as a pure function, and the state that it carries."""

from collections.abc import Callable
from typing import Any, TypeVar, cast

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from dsvla_jax.encoding.encode import model_inputs
from dsvla_jax.encoding.number_targets import NumberTargets
from dsvla_jax.experiment import Experiment, OptimizerConfig
from dsvla_jax.model.partition import constrain, shardings
from dsvla_jax.model.variables import CAMERA_EMBEDDING, Variables, join_variables, narrow_frozen, split_variables
from dsvla_jax.model.vla import VLA, initialize
from dsvla_jax.training.objective import answer_counts, answer_loss
from dsvla_jax.types import Array, Example


@struct.dataclass
class TrainState:
    """What a step changes, and all that the next one needs.

    step: int32 (). trainable: the variables that learn. optimizer: optax state over exactly those.
    skipped: int32 (), steps whose loss or gradient was not finite; they changed nothing.
    rng: the key of what is random in the network, the same at every step; a step folds its number in.
    """

    step: Array
    trainable: Variables
    optimizer: optax.OptState
    skipped: Array
    rng: Array


Summed = TypeVar("Summed")
TrainStep = Callable[[TrainState, Variables, Example[Array]], tuple[TrainState, dict[str, Array]]]


def initial_state(
    experiment: Experiment,
    number_values: np.ndarray | None,
    optimizer: optax.GradientTransformation,
    base: Variables | None = None,
) -> tuple[TrainState, Variables]:
    """State and frozen variables at step 0: random by the seed, the towers of ``base`` in the place of random ones.

    number_values: the tokenizer's; embeddings may have more rows than it has tokens.
    Pure: `make_sharded` makes every leaf where it lives, and none of them is ever whole on one device.
    """
    if number_values is not None:
        more = experiment.model.language.vocab_size - len(number_values)
        number_values = np.pad(number_values, (0, more), constant_values=np.nan)
    variables = initialize(experiment.model, jax.random.key(experiment.seed), number_values)
    embedding = variables["params"]["vision"].get(CAMERA_EMBEDDING)
    for collection, towers in (base or {}).items():
        variables[collection] = {**variables[collection], **towers}
    if embedding is not None:
        # A base that reads one camera has none.
        variables["params"]["vision"] = {CAMERA_EMBEDDING: embedding, **variables["params"]["vision"]}
    trainable, frozen = split_variables(variables, experiment.regime)
    state = start_state(trainable, optimizer, experiment.seed)
    return state, narrow_frozen(frozen, experiment.model.frozen_dtype)


def start_state(trainable: Variables, optimizer: optax.GradientTransformation, seed: int) -> TrainState:
    """The state at step 0 of variables that learn."""
    zero = jnp.zeros((), jnp.int32)
    return TrainState(zero, trainable, optimizer.init(trainable), jnp.zeros_like(zero), jax.random.key(seed))


def make_optimizer(config: OptimizerConfig, steps: int) -> optax.GradientTransformation:
    """AdamW; weight decay only on matrices, as norms, biases and embeddings of single rows are no places for it."""
    warmup = min(config.warmup_steps, max(steps // 5, 1), steps - 1)
    schedule = optax.warmup_cosine_decay_schedule(
        0.0, config.learning_rate, warmup, steps, end_value=config.learning_rate * config.final_fraction
    )
    return optax.chain(
        optax.clip_by_global_norm(config.gradient_clip),
        optax.adamw(
            schedule,
            config.beta1,
            config.beta2,
            weight_decay=config.weight_decay,
            mask=lambda tree: jax.tree_util.tree_map_with_path(
                lambda path, leaf: leaf.ndim > 1 and "kernel" in jax.tree_util.keystr(path[-1:]), tree
            ),
        ),
    )


def make_train_step(
    experiment: Experiment, model: VLA, optimizer: optax.GradientTransformation, targets: NumberTargets
) -> TrainStep:
    """``step(state, frozen, batch) -> (state, metrics)``, to be jitted by the caller (`jit_train_step`).

    Gradients are taken with respect to the trainable variables only: frozen parameters cost no weight gradient.
    A step whose loss or gradient is not finite leaves variables and optimizer as they were, and is counted.
    targets: of the tokenizer and style that the batches were written with.
    """

    def step(state: TrainState, frozen: Variables, batch: Example[Array]) -> tuple[TrainState, dict[str, Array]]:
        counts = answer_counts(batch, targets)

        def part(batch: Example[Array]) -> tuple[Variables, dict[str, Array]]:
            batch = jax.tree.map(lambda leaf: constrain(leaf, "batch"), batch)
            inputs = model_inputs(batch.pictures, batch.text, experiment.encoding)

            def loss_of(trainable: Variables):
                dropout = jax.random.fold_in(state.rng, state.step)
                logits = model.apply(join_variables(trainable, frozen), inputs, rngs={"dropout": dropout})
                assert isinstance(logits, jax.Array)
                return answer_loss(logits, batch, targets, counts)

            gradients, metrics = jax.grad(loss_of, has_aux=True)(state.trainable)
            return gradients, metrics

        gradients, metrics = _sum_over_parts(part, batch, experiment.gradient_accumulation)
        updates, optimizer_state = optimizer.update(gradients, state.optimizer, state.trainable)
        trainable = cast(Variables, optax.apply_updates(state.trainable, updates))
        metrics |= gradient_norms(gradients)
        finite = jnp.isfinite(metrics["loss"]) & jnp.isfinite(metrics["gradient_norm"])
        trainable, optimizer_state = jax.tree.map(
            lambda new, old: jnp.where(finite, new, old),
            (trainable, optimizer_state),
            (state.trainable, state.optimizer),
        )
        metrics["skipped_steps"] = state.skipped + ~finite
        return TrainState(state.step + 1, trainable, optimizer_state, metrics["skipped_steps"], state.rng), metrics

    return step


def gradient_norms(gradients: Variables) -> dict[str, Array]:
    """The norm of the whole gradient, and that of each part of the network, the adapters being parts of their own."""
    parts = {
        f"gradient_norm/{name if collection == 'params' else f'{collection}/{name}'}": optax.tree.norm(part)
        for collection, tree in gradients.items()
        for name, part in tree.items()
    }
    return {"gradient_norm": jnp.sqrt(sum(norm**2 for norm in parts.values())), **parts}


def jit_train_step(step: TrainStep, state: TrainState, mesh: Mesh) -> Any:
    """The step compiled for a mesh. The state stays split as it is, and its memory is used for the next one."""

    def on_mesh(state: TrainState, frozen: Variables, batch: Example[Array]) -> tuple[TrainState, dict[str, Array]]:
        with jax.sharding.use_abstract_mesh(mesh.abstract_mesh):
            return step(state, frozen, batch)

    everywhere = NamedSharding(mesh, PartitionSpec())
    return jax.jit(on_mesh, donate_argnums=0, out_shardings=(shardings(state, mesh), everywhere))


def _sum_over_parts(part: Callable[[Example[Array]], Summed], batch: Example[Array], count: int) -> Summed:
    """The sum of ``part`` over ``count`` equal parts of a batch, one after the other.

    A part takes every count-th example, so that each device has its share of it without any exchange.
    """
    if count == 1:
        return part(batch)
    parts = jax.tree.map(lambda leaf: leaf.reshape(-1, count, *leaf.shape[1:]).swapaxes(0, 1), batch)
    zeros = jax.tree.map(jnp.zeros_like, jax.eval_shape(part, jax.tree.map(lambda leaf: leaf[0], parts)))
    return jax.lax.scan(lambda total, one: (jax.tree.map(jnp.add, total, part(one)), None), zeros, parts)[0]
