"""Compiles the training step and the decoding step for a slice of chips, and says what they would take there."""

import dataclasses
import functools
import math
import re
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import jax
import optax
from jax.sharding import Mesh

from dsvla_jax.encoding.encode import model_inputs
from dsvla_jax.encoding.grammar import build_answer_grammar
from dsvla_jax.encoding.pretrained_tokenizers import load_tokenizer
from dsvla_jax.encoding.text import Tokenizer, WordTokenizer, vocabulary
from dsvla_jax.experiment import Experiment
from dsvla_jax.model.decode import Decoded, decode_actions
from dsvla_jax.model.flops import prefill_flops
from dsvla_jax.model.partition import Tree, shardings
from dsvla_jax.model.variables import Variables, join_variables
from dsvla_jax.model.vla import VLA
from dsvla_jax.planner.hlo import program_cost
from dsvla_jax.policies.networks import make_network
from dsvla_jax.policies.registry import ConfiguredLearner, make_learner
from dsvla_jax.policies.traced_flops import product_flops
from dsvla_jax.training.chips import Chip, Slice
from dsvla_jax.training.sharding import batch_part, batch_sharding, make_mesh
from dsvla_jax.training.state import TrainState, initial_state, jit_train_step, make_optimizer, make_train_step
from dsvla_jax.types import Array, Example, Picture, PoseExample, Text


@dataclasses.dataclass(frozen=True)
class Plan:
    """What one compiled program takes on each chip. Bytes and FLOPs are those of one chip and one run.

    held: bytes of what stays in memory by kind. temporary: bytes while it runs; None where the compiler gave up
        because they do not fit (peak is then what it says it would need).
    flops: of matrix products in the compiled program, loops by their rounds. counted_flops: by hand, `flops.py`.
    traffic: of main memory, an upper estimate. collectives: by kind, see `hlo.Cost`.
    seconds: (all three overlap perfectly, none does) at the chip's published peaks.
    """

    program: str
    topology: str
    mesh: dict[str, int]
    examples: int
    held: dict[str, int]
    temporary: int | None
    peak: int
    fits: bool
    flops: int
    counted_flops: int
    traffic: int
    collectives: dict[str, int]
    seconds: tuple[float, float]
    compile_seconds: float
    unknown_loops: int = 0


def planning_tokenizer(experiment: Experiment) -> Tokenizer:
    """Loads the experiment's vocabulary, or a small one if its folder is missing.

    An integer of the small one is one token. Nothing but the few numbers of an answer depends on it.
    """
    return _vocabulary(Path(experiment.tokenizer).resolve() if experiment.tokenizer else None)


# It can take seconds to read, and every mesh that is tried asks for the shapes of a state.
@functools.cache
def _vocabulary(folder: Path | None) -> Tokenizer:
    return load_tokenizer(folder) if folder is not None and folder.exists() else WordTokenizer(vocabulary(()))


def planning_learner(experiment: Experiment) -> ConfiguredLearner:
    """The experiment's policy as it learns, with the vocabulary of `planning_tokenizer`."""
    tokenizer = planning_tokenizer(experiment)
    return make_learner(experiment.policy, tokenizer, experiment.soft_target_sigma, experiment.num_cameras)


def plan_training(experiment: Experiment, where: Slice, examples: int) -> Plan:
    """The training step with so many examples a chip. Raises UserError where the mesh does not suit the slice."""
    mesh = make_mesh(experiment.mesh, where.devices)
    experiment = dataclasses.replace(experiment, batch_size=examples * len(where.devices))
    batch_part(mesh, experiment.batch_size, experiment.gradient_accumulation)
    state, frozen, optimizer = abstract_state(experiment, mesh)
    learner, average = planning_learner(experiment), experiment.optimizer.average_decay
    step = make_train_step(learner, optimizer, experiment.gradient_accumulation, average)
    arguments = {"state": state, "frozen base": frozen, "batch": abstract_batch(experiment, mesh)}
    held = {
        "frozen base": bytes_on_a_device(frozen),
        "trainable": bytes_on_a_device(state.trainable),
        "optimizer": bytes_on_a_device(state.optimizer),
        "batch": bytes_on_a_device(arguments["batch"]),
    }
    counted = learner.flops(experiment.regime) * examples
    lowered = jit_train_step(step, state, mesh).lower(*arguments.values())
    return _plan("training step", lowered, where, mesh, examples, held, counted)


def plan_decoding(experiment: Experiment, where: Slice, examples: int) -> Plan:
    """Plans one action for each of `examples` observations a chip.

    3DS-VLA answers for one arm; a policy that answers with poses, for two.
    """
    mesh = make_mesh(experiment.mesh, where.devices)
    experiment = dataclasses.replace(experiment, batch_size=examples * len(where.devices))
    batch_part(mesh, experiment.batch_size)
    state, frozen, _ = abstract_state(experiment, mesh)
    answer, asked = _text_answer(experiment, mesh) if experiment.baseline is None else _pose_answer(experiment, mesh)

    def act(trainable: Variables, frozen: Variables, *asked: object) -> object:
        with jax.sharding.use_abstract_mesh(mesh.abstract_mesh):
            return answer(join_variables(trainable, frozen), *asked)

    arguments = (state.trainable, frozen, *asked)
    held = {
        "frozen base": bytes_on_a_device(frozen),
        "trainable": bytes_on_a_device(state.trainable),
        "batch": bytes_on_a_device(asked),
    }
    if experiment.baseline is None:
        counted = sum(prefill_flops(experiment.encoding, experiment.model).values()) * examples
    else:
        counted = product_flops(jax.make_jaxpr(act)(*arguments).jaxpr) // len(where.devices)
    return _plan("decoding", jax.jit(act).lower(*arguments), where, mesh, examples, held, counted)


def _text_answer(experiment: Experiment, mesh: Mesh) -> tuple[Callable[..., Decoded], tuple[object, ...]]:
    """3DS-VLA's decoding as a function of variables and inputs, and the shapes of the inputs."""
    grammar = build_answer_grammar(planning_tokenizer(experiment), 1, experiment.encoding.style)
    batch = abstract_batch(experiment, mesh)
    assert isinstance(batch, Example)

    def answer(variables: Variables, pictures: Picture[Array], text: Text[Array]) -> Decoded:
        inputs = model_inputs(pictures, text, experiment.encoding)
        return decode_actions(VLA(experiment.model), variables, inputs, grammar)

    return answer, (batch.pictures, batch.text)


def _pose_answer(experiment: Experiment, mesh: Mesh) -> tuple[Callable[..., Array], tuple[object, ...]]:
    """The same of a policy that answers with poses."""
    network = make_network(experiment.policy, planning_tokenizer(experiment))
    batch = abstract_batch(experiment, mesh)
    assert isinstance(batch, PoseExample)
    return partial(network.answer, key=jax.random.key(0)), (batch.inputs,)


def held_bytes(experiment: Experiment, mesh: Mesh) -> int:
    """Bytes a chip of parameters and optimizer: what must fit before anything is computed."""
    state, frozen, _ = abstract_state(experiment, mesh)
    return bytes_on_a_device((state, frozen))


def peak_bytes(compiled: jax.stages.Compiled) -> int:
    """Bytes a chip of a compiled program while it runs, by its compiler: arguments, results and temporaries."""
    memory = compiled.memory_analysis()
    assert memory is not None
    return (
        memory.argument_size_in_bytes
        + memory.output_size_in_bytes
        - memory.alias_size_in_bytes
        + memory.temp_size_in_bytes
        + memory.generated_code_size_in_bytes
    )


def roofline(chip: Chip, flops: float, traffic: float, network: float) -> tuple[float, float]:
    """Seconds if products, memory and network overlap perfectly, and if they do not at all."""
    parts = (flops / chip.flops, traffic / chip.memory_bandwidth, network / chip.network_bandwidth)
    return max(parts), sum(parts)


def _plan(
    program: str,
    lowered: jax.stages.Lowered,
    where: Slice,
    mesh: Mesh,
    examples: int,
    held: dict[str, int],
    counted: int,
) -> Plan:
    start = time.monotonic()
    plan = partial(
        Plan,
        program=program,
        topology=where.name + (" (virtual CPU devices)" if where.virtual else ""),
        mesh=dict(mesh.shape),
        examples=examples,
        held=held,
        counted_flops=counted,
    )
    try:
        compiled = lowered.compile()
    except jax.errors.JaxRuntimeError as error:
        needed = needed_bytes(str(error))
        if needed is None:
            raise
        seconds = time.monotonic() - start
        return plan(
            temporary=None, peak=needed, fits=False, flops=0, traffic=0, collectives={},
            seconds=(math.inf, math.inf), compile_seconds=seconds,
        )  # fmt: skip
    seconds = time.monotonic() - start
    memory, peak, text = compiled.memory_analysis(), peak_bytes(compiled), compiled.as_text()
    assert memory is not None
    assert text is not None
    cost = program_cost(text)
    return plan(
        temporary=memory.temp_size_in_bytes,
        peak=peak,
        fits=peak <= where.chip.memory,
        flops=cost.flops,
        traffic=cost.traffic,
        collectives=dict(cost.collectives),
        seconds=roofline(where.chip, cost.flops, cost.traffic, sum(cost.collectives.values())),
        compile_seconds=seconds,
        unknown_loops=cost.unknown_loops,
    )


def needed_bytes(message: str) -> int | None:
    """Bytes that the TPU compiler says a program needs: of all of it, or in newer ones of temporaries alone."""
    found = re.search(r"(?:Used |total memory required [^(]*\()([\d.]+)([KMG])", message)
    return int(float(found[1]) * 2 ** {"K": 10, "M": 20, "G": 30}[found[2]]) if found else None


def abstract_state(experiment: Experiment, mesh: Mesh) -> tuple[TrainState, Variables, optax.GradientTransformation]:
    """State and frozen variables as shapes with shardings, and the optimizer."""
    optimizer = make_optimizer(experiment.optimizer, experiment.steps)
    start = partial(
        initial_state,
        planning_learner(experiment),
        optimizer,
        experiment.seed,
        experiment.regime,
        experiment.model.frozen_dtype,
        experiment.optimizer.average_decay > 0,
    )
    state, frozen = jax.eval_shape(start)
    return *_placed((state, frozen), shardings((state, frozen), mesh)), optimizer


def abstract_batch(experiment: Experiment, mesh: Mesh, picture: tuple[int, int] | None = None) -> object:
    """Returns a batch of examples as shapes with shardings.

    picture: height and width, those of simulated demonstrations if not given.
    """
    size = experiment.data.image_size
    cameras = experiment.num_cameras
    batch = planning_learner(experiment).example_spec(experiment.batch_size, cameras, *(picture or (size, size)))
    return _placed(batch, jax.tree.map(lambda _: batch_sharding(mesh), batch))


def _placed(tree: Tree, where: object) -> Tree:
    return jax.tree.map(lambda leaf, sharding: leaf.update(sharding=sharding), tree, where)


def bytes_on_a_device(tree: object) -> int:
    """Of a tree of shapes with shardings, what each device holds."""

    def size(leaf: jax.ShapeDtypeStruct) -> int:
        assert leaf.sharding is not None
        return math.prod(leaf.sharding.shard_shape(leaf.shape)) * leaf.dtype.itemsize

    return sum(map(size, jax.tree.leaves(tree)))
