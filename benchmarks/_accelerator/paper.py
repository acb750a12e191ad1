"""The paper's model at full size with random weights: the training step, and one action.

LLaMA's vocabulary cannot be had here. A small one that splits digits as LLaMA's does is used in its place: prompts and
answers take about as many passes.
"""

import dataclasses
import time
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks._accelerator.device import gib
from benchmarks._accelerator.sections import DecodeCase, Job, Size, TrainCase
from benchmarks._timing import Timing, timed
from configs import get_config
from data_pipelines.records import Frame
from data_pipelines.samples import make_sampler
from dsvla_jax.data_config import DataConfig
from dsvla_jax.encoding.config import EncodingConfig
from dsvla_jax.encoding.point_tokens import PointTokenizerConfig
from dsvla_jax.encoding.text import Tokenizer
from dsvla_jax.experiment import Experiment
from dsvla_jax.geometry.cameras import front_camera
from dsvla_jax.model.config import LanguageConfig, LoraConfig, VisionConfig, VisualPromptConfig
from dsvla_jax.model.flops import model_flops, prefill_flops
from dsvla_jax.model.partition import shardings
from dsvla_jax.model.quantize import quantize
from dsvla_jax.model.variables import join_variables
from dsvla_jax.planner.planning import held_bytes, peak_bytes
from dsvla_jax.policies.config import PolicyConfig
from dsvla_jax.policies.three_ds_vla import TextPolicy, text_learner
from dsvla_jax.training.chips import peak_flops
from dsvla_jax.training.sharding import make_mesh, put_batch
from dsvla_jax.training.state import initial_state, jit_train_step, make_optimizer, make_train_step, start_state
from dsvla_jax.types import Action, Example, Observation, Picture, RobotState
from tests.vocabularies import INSTRUCTIONS, small_tokenizer

# What variables of these names begin with; all others are random.
CONSTANTS = {"scale": 1.0, "bias": 0.0, "gate": 0.0, "b": 0.0}
# Seconds that another batch size is expected to take, its compiling included.
ANOTHER = 60.0


def paper_experiment(size: Size) -> Experiment:
    """The config as it is, or one of the same parts that a CPU compiles in seconds."""
    full = get_config("paper_7b")
    if size == "full":
        return full
    points = PointTokenizerConfig(num_points=64, group_sizes=(16, 8), neighbours=4, width=32)
    return dataclasses.replace(
        full,
        encoding=EncodingConfig(image_size=32, patch_size=16, points=points, stride=1),
        model=dataclasses.replace(
            full.model,
            vision=VisionConfig(image_size=32, patch_size=16, width=32, layers=1, heads=2, embed_width=16),
            language=LanguageConfig(vocab_size=600, width=32, layers=2, heads=2, kv_heads=2, ffn=64),
            visual_prompt=VisualPromptConfig(width=32, layers=1, heads=2, ffn=64),
            lora=LoraConfig(rank=2, alpha=2.0),
        ),
        data=dataclasses.replace(full.data, image_size=32),
    )


def frames(experiment: Experiment, count: int) -> list[Frame]:
    """Frames of one arm that nobody has recorded: random pictures, poses and depths over the table."""
    rng, size = np.random.default_rng(0), experiment.data.image_size
    camera = jax.tree.map(lambda x: np.asarray(x)[None], front_camera(size))

    def pose() -> np.ndarray:
        turn = rng.normal(size=(1, 4))
        return np.concatenate(
            [rng.uniform([0.0, -0.4, 0.8], [0.5, 0.4, 1.4], (1, 3)), turn / np.linalg.norm(turn)], axis=1
        ).astype(np.float32)

    return [
        Frame(
            pictures=Picture(
                rng.integers(0, 256, (1, size, size, 3), dtype=np.uint8),
                rng.uniform(0.8, 1.3, (1, size, size)).astype(np.float32),
                camera,
            ),
            robot=RobotState(pose(), np.ones(1, np.float32)),
            keypoint=pose()[:, :3],
            target=Action(pose(), np.zeros(1, np.float32)),
            instruction=INSTRUCTIONS[number % len(INSTRUCTIONS)],
            task="lamp_on",
            task_index=0,
            episode=number,
            frame=0,
        )
        for number in range(count)
    ]


def train_batch(experiment: Experiment, tokenizer: Tokenizer, size: int) -> Example[np.ndarray]:
    """A batch of such frames as training reads it."""
    plain = DataConfig(keypoint_noise=0.0, image_size=experiment.data.image_size)
    sample = make_sampler(plain, experiment.encoding, tokenizer)
    samples = [sample(one, np.random.default_rng(0)) for one in frames(experiment, size)]
    return jax.tree.map(lambda *leaves: np.stack(leaves), *samples)


def random_variables(shapes: Any, mesh: jax.sharding.Mesh) -> Any:
    """Random variables of these shapes, made on the device one after the other, the largest first.

    As one program they would all be there in float32 at once: the process's peak memory would be that of this
    beginning, and say nothing about what comes after.
    """
    leaves, structure = jax.tree_util.tree_flatten_with_path(shapes)
    places = jax.tree.leaves(shardings(shapes, mesh))
    # The quickest of the generators on an accelerator.
    keys = jax.random.split(jax.random.key(0, impl="rbg"), len(leaves))
    made: list[Any] = [None] * len(leaves)
    for number in sorted(range(len(leaves)), key=lambda number: -leaves[number][1].size):
        (path, leaf), place = leaves[number], places[number]
        if (name := path[-1].key) in CONSTANTS:
            made[number] = jnp.full(leaf.shape, CONSTANTS[name], leaf.dtype, device=place)
        else:
            made[number] = jax.jit(random_leaf, static_argnums=(1, 2), out_shardings=place)(
                keys[number], leaf.shape, leaf.dtype
            )
    return structure.unflatten(made)


def random_leaf(key: jax.Array, shape: tuple[int, ...], dtype: Any) -> jax.Array:
    """One variable, at the scale that it begins with."""
    scale = jnp.asarray(shape[-2] ** -0.5 if len(shape) > 1 else 1.0, dtype)
    if len(shape) == 3:
        # A layer at a time, because a generator's bits take several times the memory of what is made from them.
        draw = partial(jax.random.normal, shape=shape[1:], dtype=dtype)
        return jax.lax.map(lambda one: draw(one) * scale, jax.random.split(key, shape[0]))
    return jax.random.normal(key, shape, dtype) * scale


def make_weights(job: Job) -> dict[str, Any]:
    """State and frozen weights, once for the sections of this module."""
    if "frozen" not in job.shared:
        experiment = paper_experiment(job.sizes.name)
        mesh, optimizer = one_device(experiment), make_optimizer(experiment.optimizer, experiment.steps)
        start = time.perf_counter()
        learner = text_learner(experiment.encoding, experiment.model, small_tokenizer("sentencepiece"))
        dtype = experiment.model.frozen_dtype
        start_shapes = partial(initial_state, learner, optimizer, experiment.seed, experiment.regime, dtype)
        state, frozen = jax.eval_shape(start_shapes)
        trainable, job.shared["frozen"] = random_variables((state.trainable, frozen), mesh)
        parameters = sum(leaf.size for leaf in jax.tree.leaves((trainable, frozen)))
        begin = partial(start_state, optimizer=optimizer, seed=experiment.seed)
        job.shared["state"] = jax.jit(begin, donate_argnums=0, out_shardings=shardings(state, mesh))(trainable)
        jax.block_until_ready(job.shared)
        figures = {"seconds": time.perf_counter() - start, "in_use_gib": gib("bytes_in_use"), "peak_gib": gib(_PEAK)}
        job.note(parameters=parameters, weights=figures)
    return job.shared


_PEAK = "peak_bytes_in_use"


def one_device(experiment: Experiment) -> jax.sharding.Mesh:
    """The config's mesh over the first device."""
    return make_mesh(experiment.mesh, jax.devices()[:1])


def train(job: Job) -> None:
    """The training step by batch size: time, use of the device, memory as planned and as it was."""
    experiment, tokenizer = paper_experiment(job.sizes.name), small_tokenizer("sentencepiece")
    mesh, peak = one_device(experiment), peak_flops(jax.devices()[:1])
    shared = make_weights(job)
    optimizer = make_optimizer(experiment.optimizer, experiment.steps)
    for number, case in enumerate(job.sizes.train):
        if number and too_late(job, case.name):
            continue
        size, one = case.batch, train_experiment(experiment, case)
        batch = put_batch(train_batch(one, tokenizer, size), mesh)
        learner = text_learner(one.encoding, one.model, tokenizer, one.soft_target_sigma)
        step = jit_train_step(make_train_step(learner, optimizer), shared["state"], mesh)
        start = time.perf_counter()
        lowered = step.lower(shared["state"], shared["frozen"], batch)
        traced = time.perf_counter() - start
        compiled = lowered.compile()
        compile_seconds, planned = time.perf_counter() - start - traced, peak_bytes(compiled) / 2**30
        if (room := gib("bytes_limit")) and planned > room:
            job.note(**{case.name: {"skipped": f"planned {planned:.1f} GiB, there are {room:.1f}"}})
            continue

        def once(compiled: Any = compiled, batch: Any = batch) -> Any:
            # The state is consumed, so there is none until the step is done.
            shared["state"], metrics = compiled(shared.pop("state"), shared["frozen"], batch)
            return metrics

        metrics, timing = timed(once, job.sizes.train_steps)
        flops, positions = (
            model_flops(one.encoding, one.model, one.regime) * size,
            size * experiment.encoding.max_text_length,
        )
        figures: dict[str, Any] = {
            **timing.figures(),
            "compile_seconds": compile_seconds,
            "trace_seconds": traced,
            "examples_per_second": size / timing.median,
            # As metrics.jsonl counts them, and with the padding, which is computed all the same.
            "tokens_per_second": int(batch.text.mask.sum()) / timing.median,
            "positions_per_second": positions / timing.median,
            "tflops": flops / timing.median / 1e12,
            "utilisation": flops / timing.median / peak if peak else 0.0,
            "planned_gib": planned,
            "held_gib": held_bytes(one, mesh) / 2**30,
            "peak_gib": gib(_PEAK),
            "loss": float(metrics["loss"]),
            "skipped_steps": int(metrics["skipped_steps"]),
        }
        job.note(**{case.name: figures})


def train_experiment(experiment: Experiment, case: TrainCase) -> Experiment:
    """The config with what the case changes."""
    changes = {name: value for name in ("remat", "attention") if (value := getattr(case, name))}
    model = dataclasses.replace(experiment.model, **changes)
    return dataclasses.replace(experiment, batch_size=case.batch, model=model)


def too_late(job: Job, name: str) -> bool:
    """Whether too little time is left for another case, which the report then says."""
    if job.sizes.name != "full" or job.left() > ANOTHER:
        return False
    job.note(**{name: {"skipped": f"{job.left():.0f} s were left"}})
    return True


def decode(job: Job) -> None:
    """From observations to keyframes on the host, for several numbers of robots that ask together."""
    experiment, tokenizer = paper_experiment(job.sizes.name), small_tokenizer("sentencepiece")
    shared = make_weights(job)
    state, frozen = shared.pop("state"), shared.pop("frozen")
    variables = join_variables(state.trainable, frozen)
    del state, frozen
    base = "bfloat16"
    for number, case in enumerate(job.sizes.decode):
        if number and too_late(job, case.name):
            continue
        if case.base != base:
            variables, base = {**variables, "params": jax.jit(quantize, donate_argnums=0)(variables["params"])}, "int8"
        policy, robots = TextPolicy(policy_config(experiment, case), variables, tokenizer), case.robots
        asked = frames(experiment, robots)
        seen = [(Observation(one.pictures, one.robot), one.keypoint) for one in asked]
        observation, keypoints = jax.tree.map(lambda *leaves: np.stack(leaves), *seen)
        observation = jax.tree.map(jnp.asarray, observation)
        instructions = [one.instruction for one in asked]

        def act(policy: TextPolicy = policy, asked: Any = (observation, instructions, keypoints)) -> Action[np.ndarray]:
            return policy.decide(*asked).action

        try:
            action, timing = timed(act, job.sizes.actions)
        except jax.errors.JaxRuntimeError as error:
            if "RESOURCE_EXHAUSTED" not in str(error):
                raise
            job.note(**{case.name: {"skipped": "too little memory"}})
            continue
        assert np.isfinite(np.asarray(action.pose)).all()
        job.note(**{case.name: decode_figures(experiment, robots, timing)})
    job.note(peak_gib=gib(_PEAK))


def policy_config(experiment: Experiment, case: DecodeCase) -> PolicyConfig:
    """What the case's policy is."""
    model = experiment.model
    if case.base == "int8":
        model = dataclasses.replace(model, base_dtype="int8")
    if case.attention:
        model = dataclasses.replace(model, attention=case.attention)
    return PolicyConfig(experiment.encoding, model)


def decode_figures(experiment: Experiment, robots: int, timing: Timing) -> dict[str, float]:
    """Milliseconds until all robots have their action: the median, and the slowest twentieth's beginning."""
    later = sorted(timing.later)
    return {
        **timing.figures(),
        "milliseconds": 1e3 * timing.median,
        "milliseconds_p95": 1e3 * later[min(len(later) - 1, int(0.95 * len(later)))],
        "actions_per_second": robots / timing.median,
        "prefill_tflop": robots * sum(prefill_flops(experiment.encoding, experiment.model).values()) / 1e12,
    }
