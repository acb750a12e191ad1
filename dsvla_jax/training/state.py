"""The training step as a pure function, and the state that it carries."""

from collections.abc import Callable
from typing import Never, TypeVar, cast

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from optax.contrib import MuonDimensionNumbers, muon

from dsvla_jax.experiment import OptimizerConfig
from dsvla_jax.model.partition import constrain, shardings
from dsvla_jax.model.variables import (
    CAMERA_EMBEDDING,
    Regime,
    Variables,
    join_variables,
    narrow_frozen,
    split_variables,
)
from dsvla_jax.policies.interface import Learner, Metrics
from dsvla_jax.types import Array

# Root mean square of AdamW's updates at a learning rate of 1, as Liu et al. 2025 (arXiv 2502.16982) measured it.
ADAM_RMS = 0.2


@struct.dataclass
class TrainState:
    """What a step changes, and all that the next one needs.

    step: int32 (). trainable: the variables that learn. optimizer: optax state over exactly those.
    skipped: int32 (), steps whose loss or gradient was not finite; they changed nothing.
    rng: the key of what is random in the network, the same at every step; a step folds its number in.
    average: the moving average of the variables that learn, by which the policy acts; None where there is none.
    """

    step: Array
    trainable: Variables
    optimizer: optax.OptState
    skipped: Array
    rng: Array
    average: Variables | None = None

    @property
    def acting(self) -> Variables:
        """Those of the variables that learn by which the policy acts."""
        return self.trainable if self.average is None else self.average


Example = TypeVar("Example")
Summed = TypeVar("Summed")
TrainStep = Callable[[TrainState, Variables, Example], tuple[TrainState, Metrics]]


def initial_state(
    learner: Learner[Never, Never],
    optimizer: optax.GradientTransformation,
    seed: int,
    regime: Regime,
    frozen_dtype: jnp.dtype,
    average: bool = False,
    base: Variables | None = None,
) -> tuple[TrainState, Variables]:
    """State and frozen variables at step 0: random by the seed, the towers of ``base`` in the place of random ones.

    frozen_dtype: of matrices that do not learn. average: whether there is a moving average.
    Pure: `make_sharded` makes every leaf where it lives, and none of them is ever whole on one device.
    """
    variables = learner.initialise(jax.random.key(seed))
    embedding = variables["params"].get("vision", {}).get(CAMERA_EMBEDDING)
    for collection, towers in (base or {}).items():
        variables[collection] = {**variables[collection], **towers}
    if embedding is not None:
        # A base that reads one camera has none.
        variables["params"]["vision"] = {CAMERA_EMBEDDING: embedding, **variables["params"]["vision"]}
    trainable, frozen = split_variables(variables, regime)
    return start_state(trainable, optimizer, seed, average), narrow_frozen(frozen, frozen_dtype)


def start_state(
    trainable: Variables, optimizer: optax.GradientTransformation, seed: int, average: bool = False
) -> TrainState:
    """The state at step 0 of variables that learn."""
    zero = jnp.zeros((), jnp.int32)
    # A copy, because a step gives up the memory of all that it is given.
    mean = jax.tree.map(jnp.copy, trainable) if average else None
    return TrainState(zero, trainable, optimizer.init(trainable), jnp.zeros_like(zero), jax.random.key(seed), mean)


def make_optimizer(config: OptimizerConfig, steps: int) -> optax.GradientTransformation:
    """Returns AdamW or Muon, with weight decay on kernels only."""
    warmup = min(config.warmup_steps, max(steps // 5, 1), steps - 1)
    schedule = optax.warmup_cosine_decay_schedule(
        0.0, config.learning_rate, warmup, steps, end_value=config.learning_rate * config.final_fraction
    )
    if config.method == "muon":
        method = muon(
            schedule,
            weight_decay=config.weight_decay,
            adam_b1=config.beta1,
            adam_b2=config.beta2,
            adam_weight_decay=0.0,
            muon_weight_dimension_numbers=_matrices,
            consistent_rms=ADAM_RMS,
        )
    else:
        method = optax.adamw(schedule, config.beta1, config.beta2, weight_decay=config.weight_decay, mask=_is_decayed)
    return optax.chain(optax.clip_by_global_norm(config.gradient_clip), method)


def _is_decayed(tree: optax.Params) -> optax.Params:
    """Returns True for kernels of more than one dimension."""
    return jax.tree_util.tree_map_with_path(
        lambda path, leaf: leaf.ndim > 1 and "kernel" in jax.tree_util.keystr(path[-1:]), tree
    )


def _matrices(tree: optax.Params) -> optax.Params:
    """Returns Muon's axes for the kernels of dense layers, stacked ones as separate matrices; None for other leaves."""

    def read_as(path: jax.tree_util.KeyPath, leaf: Array) -> MuonDimensionNumbers | None:
        is_dense = path[-1] == jax.tree_util.DictKey("kernel") and leaf.ndim in (2, 3)
        return MuonDimensionNumbers(reduction_axis=-2, output_axis=-1) if is_dense else None

    return jax.tree_util.tree_map_with_path(read_as, tree)


def make_train_step(
    learner: Learner[Example, Never],
    optimizer: optax.GradientTransformation,
    accumulation: int = 1,
    average_decay: float = 0.0,
) -> TrainStep[Example]:
    """``step(state, frozen, batch) -> (state, metrics)``, to be jitted by the caller (`jit_train_step`).

    Gradients are taken with respect to the trainable variables only: frozen parameters cost no weight gradient.
    A step whose loss or gradient is not finite leaves variables and optimizer as they were, and is counted.
    accumulation: parts in which a batch is computed. average_decay: of the state's moving average, see `average_with`.
    """

    def step(state: TrainState, frozen: Variables, batch: Example) -> tuple[TrainState, Metrics]:
        totals, key = learner.totals(batch), jax.random.fold_in(state.rng, state.step)

        def part(batch: Example) -> tuple[Variables, Metrics]:
            batch = jax.tree.map(lambda leaf: constrain(leaf, "batch"), batch)

            def loss_of(trainable: Variables) -> tuple[Array, Metrics]:
                return learner.loss(join_variables(trainable, frozen), batch, totals, key)

            gradients, metrics = jax.grad(loss_of, has_aux=True)(state.trainable)
            return gradients, metrics

        gradients, metrics = _sum_over_parts(part, batch, accumulation)
        updates, optimizer_state = optimizer.update(gradients, state.optimizer, state.trainable)
        trainable = cast(Variables, optax.apply_updates(state.trainable, updates))
        average = state.average and average_with(state.average, trainable, state.step, average_decay)
        metrics |= gradient_norms(gradients)
        finite = jnp.isfinite(metrics["loss"]) & jnp.isfinite(metrics["gradient_norm"])
        trainable, optimizer_state, average = jax.tree.map(
            lambda new, old: jnp.where(finite, new, old),
            (trainable, optimizer_state, average),
            (state.trainable, state.optimizer, state.average),
        )
        skipped = metrics["skipped_steps"] = state.skipped + ~finite
        return TrainState(state.step + 1, trainable, optimizer_state, skipped, state.rng, average), metrics

    return step


def average_with(average: Variables, trainable: Variables, step: Array, decay: float) -> Variables:
    """The moving average with the variables after a step in it.

    decay: the largest share of the old average; at first it is 1 - (1 + step)^-0.75, as the code of 3D Diffusion Policy
    has it (diffusion_policy_3d/model/diffusion/ema_model.py).
    """
    kept = jnp.minimum(decay, 1 - (1.0 + step) ** -0.75)
    return jax.tree.map(lambda mean, new: kept * mean + (1 - kept) * new, average, trainable)


def gradient_norms(gradients: Variables) -> Metrics:
    """The norm of the whole gradient, and that of each part of the network, the adapters being parts of their own."""
    parts = {
        f"gradient_norm/{name if collection == 'params' else f'{collection}/{name}'}": optax.tree.norm(part)
        for collection, tree in gradients.items()
        for name, part in tree.items()
    }
    return {"gradient_norm": jnp.sqrt(sum(norm**2 for norm in parts.values())), **parts}


def jit_train_step(step: TrainStep[Example], state: TrainState, mesh: Mesh) -> jax.stages.Wrapped:
    """The step compiled for a mesh. The state stays split as it is, and its memory is used for the next one."""

    def on_mesh(state: TrainState, frozen: Variables, batch: Example) -> tuple[TrainState, Metrics]:
        with jax.sharding.use_abstract_mesh(mesh.abstract_mesh):
            return step(state, frozen, batch)

    everywhere = NamedSharding(mesh, PartitionSpec())
    return jax.jit(on_mesh, donate_argnums=0, out_shardings=(shardings(state, mesh), everywhere))


def _sum_over_parts(part: Callable[[Example], Summed], batch: Example, count: int) -> Summed:
    """The sum of ``part`` over ``count`` equal parts of a batch, one after the other.

    A part takes every count-th example, so that each device has its share of it without any exchange.
    """
    if count == 1:
        return part(batch)
    parts = jax.tree.map(lambda leaf: leaf.reshape(-1, count, *leaf.shape[1:]).swapaxes(0, 1), batch)
    zeros = jax.tree.map(jnp.zeros_like, jax.eval_shape(part, jax.tree.map(lambda leaf: leaf[0], parts)))
    return jax.lax.scan(lambda total, one: (jax.tree.map(jnp.add, total, part(one)), None), zeros, parts)[0]
