"""The closed loop with the paper's 7B policy compiles for a TPU v5e 4x4 slice and fits it (20 minutes).

Usage: python -m benchmarks.device_loop_tpu [--task lamp_on] [--episodes 64]

Ahead of time and from any CPU: it needs the libtpu package (pip install libtpu), not a TPU. Exits with 77
where libtpu is missing, with 1 where the program does not fit. Weights are bfloat16, split over all chips; episodes
are spread over them. In place of LLaMA's vocabulary, one of 32,000 words, with an integer a token.
"""

import dataclasses
import itertools
import string
import sys
import time
from typing import Any

import jax
import jax.numpy as jnp
import tyro
from jax.sharding import NamedSharding, PartitionSpec

from configs.paper_7b import config as paper_7b
from dsvla_jax.command_line import fail_with_message
from dsvla_jax.encoding.text import WordTokenizer, vocabulary
from dsvla_jax.evaluation.device_loop import device_loop
from dsvla_jax.experiment import MeshConfig
from dsvla_jax.model.decode import GREEDY
from dsvla_jax.model.partition import shardings
from dsvla_jax.model.vla import initialize
from dsvla_jax.policies.config import PolicyConfig
from dsvla_jax.policies.three_ds_vla import TextOnDevice
from dsvla_jax.sim.environment import Environment
from dsvla_jax.training.chips import find_slice
from dsvla_jax.training.sharding import make_mesh

CHIP_GIB, NO_LIBTPU = 16, 77


@dataclasses.dataclass(frozen=True)
class Options:
    """What to compile."""

    task: str = "lamp_on"
    episodes: int = 64


def words(count: int, instructions: list[str]) -> WordTokenizer:
    """A word-level tokenizer of so many tokens, which knows the instructions."""
    known = vocabulary(instructions)
    missing = count - WordTokenizer(known).vocab_size
    letters = ("".join(word) for word in itertools.product(string.ascii_lowercase, repeat=4))
    filler = (word for word in letters if word not in known)
    return WordTokenizer((*known, *itertools.islice(filler, missing)))


def main(options: Options) -> int:
    where = find_slice("v5e:4x4")
    if where.virtual:
        print("no TPU compiler: pip install libtpu", file=sys.stderr)
        return NO_LIBTPU
    mesh = make_mesh(MeshConfig(data=1, fsdp=-1), where.devices)
    experiment = paper_7b()
    model = dataclasses.replace(experiment.model, remat="none", attention="fused")
    environment = Environment(options.task, "mjx", image_size=experiment.data.image_size)
    tokenizer = words(model.language.vocab_size, environment.task.all_instructions())
    config = PolicyConfig(experiment.encoding, model)
    said = [environment.task.say(0)] * options.episodes
    policy = TextOnDevice(config, tokenizer, GREEDY, environment.num_arms, tuple(environment.task.all_instructions()))
    question = policy.ask(said)
    loop = device_loop(environment, policy, 2 * environment.expert_keyframes)

    variables = jax.eval_shape(lambda: initialize(model, jax.random.key(0)))
    variables = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, jnp.bfloat16), variables)
    state = jax.eval_shape(
        environment.reset, jax.eval_shape(lambda: jax.random.split(jax.random.key(0), options.episodes))
    )
    spread, everywhere = NamedSharding(mesh, PartitionSpec(("data", "fsdp"))), NamedSharding(mesh, PartitionSpec())

    def placed(tree: Any, sharding: Any) -> Any:
        if isinstance(sharding, NamedSharding):
            sharding = jax.tree.map(lambda _: sharding, tree)
        return jax.tree.map(lambda x, s: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=s), tree, sharding)

    inputs = (
        placed(environment.physics, everywhere),
        placed(variables, shardings(variables, mesh)),
        placed(state, spread),
        placed(jax.eval_shape(environment.keypoints, state), spread),
        placed(jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), question), spread),
    )
    start = time.perf_counter()
    with jax.set_mesh(mesh):
        lowered = jax.jit(loop).lower(*inputs)
        print(f"{options.task}: lowered in {time.perf_counter() - start:.0f} s", flush=True)
        memory: Any = lowered.compile().memory_analysis()
    sizes = memory.temp_size_in_bytes + memory.argument_size_in_bytes + memory.output_size_in_bytes
    print(
        f"{options.task}, {options.episodes} episodes on v5e 4x4: {sizes / 2**30:.2f} GiB of {CHIP_GIB} a chip "
        f"(arguments {memory.argument_size_in_bytes / 2**30:.2f}, temporary {memory.temp_size_in_bytes / 2**30:.2f}), "
        f"{time.perf_counter() - start:.0f} s",
        flush=True,
    )
    return int(sizes > CHIP_GIB * 2**30)


if __name__ == "__main__":
    with fail_with_message():
        sys.exit(main(tyro.cli(Options, description=__doc__)))
