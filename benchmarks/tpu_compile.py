"""Observing and executing a keyframe compile for a TPU v5e 2x2 slice, 1,024 episodes, every task (20 minutes).

Usage: python -m benchmarks.tpu_compile [--tasks ...] [--episodes 1024] [--out docs/tpu_compile.json]
then python -m docs.gallery writes the figures into docs/tasks.md.

Ahead of time and from any CPU: it needs the libtpu package (pip install libtpu), not a TPU. Exits with 77
where libtpu is missing. With --out, tasks that the file already has are not compiled again.
"""

import dataclasses
import json
import sys
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np
import tyro
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from dsvla_jax.command_line import fail_with_message
from dsvla_jax.sim.environment import Environment, step
from dsvla_jax.sim.physics import Physics, SimState
from dsvla_jax.sim.tasks import select_tasks
from dsvla_jax.training.chips import find_slice
from dsvla_jax.types import Action, Observation

IMAGE_SIZE, CHIP_GIB, NO_LIBTPU = 128, 16, 77


@dataclasses.dataclass(frozen=True)
class Options:
    """What to compile."""

    tasks: tuple[str, ...] = ("all",)
    episodes: int = 1024
    out: Path | None = None


def compile_keyframe(name: str, episodes: int, mesh: Mesh) -> dict[str, Any]:
    """Compiles one closed-loop turn; seconds to lower and to compile, and MiB a chip."""
    environment = Environment(name, physics="mjx", image_size=IMAGE_SIZE)

    def turn(physics: Physics, state: SimState, action: Action) -> tuple[SimState, Observation]:
        state = step(environment.scene, physics, state, action)
        return state, environment.observe(state)

    spread, everywhere = NamedSharding(mesh, PartitionSpec("data")), NamedSharding(mesh, PartitionSpec())
    keys = jax.eval_shape(lambda: jax.random.split(jax.random.key(0), episodes))
    state = jax.eval_shape(environment.reset, keys)
    action = jax.eval_shape(lambda state: jax.tree.map(lambda x: x[:, 0], environment.expert(state)), state)

    def placed(tree: Any, sharding: NamedSharding) -> Any:
        return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=sharding), tree)

    start = time.perf_counter()
    lowered = jax.jit(turn).lower(
        placed(environment.physics, everywhere), placed(state, spread), placed(action, spread)
    )
    middle = time.perf_counter()
    memory: Any = lowered.compile().memory_analysis()
    sizes = memory.temp_size_in_bytes + memory.argument_size_in_bytes + memory.output_size_in_bytes
    return {
        "lower_seconds": round(middle - start, 1),
        "compile_seconds": round(time.perf_counter() - middle, 1),
        "mib_a_chip": round(sizes / 2**20),
        "episodes": episodes,
    }


def main(options: Options) -> int:
    where = find_slice("v5e:2x2")
    if where.virtual:
        print("no TPU compiler: pip install libtpu", file=sys.stderr)
        return NO_LIBTPU
    mesh = Mesh(np.array(where.devices), ("data",))
    results = json.loads(options.out.read_text()) if options.out and options.out.exists() else {}
    for name in select_tasks(options.tasks):
        if name not in results:
            results[name] = compile_keyframe(name, options.episodes, mesh)
            if options.out:
                options.out.write_text(json.dumps(results, indent=1, sort_keys=True) + "\n")
        result = results[name]
        print(f"{name:36} " + "  ".join(f"{key} {value}" for key, value in result.items()), flush=True)
    return int(any(result["mib_a_chip"] > CHIP_GIB * 1024 for result in results.values()))


if __name__ == "__main__":
    with fail_with_message():
        sys.exit(main(tyro.cli(Options, description=__doc__)))
