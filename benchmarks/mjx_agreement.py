"""Experts' actions in MJX and C MuJoCo from the same states: outcomes agree on >= 95 % of 20 episodes a task (1 hour).

Usage: python -m benchmarks.mjx_agreement [--tasks lamp_on ...] [--episodes 20] [--out FILE]
"""

import dataclasses
import json
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from dsvla_jax.command_line import configure_jax, fail_with_message
from dsvla_jax.sim.environment import Environment
from dsvla_jax.sim.physics import SimState
from dsvla_jax.sim.seeds import episode_keys
from dsvla_jax.sim.tasks import select_tasks
from dsvla_jax.types import Action


@dataclasses.dataclass(frozen=True)
class Options:
    """Which tasks, on how many episodes."""

    tasks: tuple[str, ...] = ("all",)
    episodes: int = 20
    out: Path | None = None
    """A line of JSON is added for each task; tasks that have one already are not run again."""


def outcomes(environment: Environment, start: SimState, plan: Action) -> np.ndarray:
    """bool (B,): which episodes succeed that begin so and follow a plan of poses (B, M, A, 7)."""
    return np.asarray(environment.success(environment.follow(start, plan)[-1]))


def compare(name: str, episodes: int) -> dict[str, float | str]:
    """Both kinds of physics from the state that C MuJoCo settles into, with the plan made from it."""
    reference, environment = Environment(name), Environment(name, physics="mjx")
    start = jax.tree.map(jnp.asarray, reference.reset(episode_keys(0, "validation", name, 0, episodes)))
    plan = reference.expert(start)
    began = time.monotonic()
    first, second = outcomes(reference, start, plan), outcomes(environment, start, plan)
    return {
        "task": name,
        "mujoco": int(first.sum()),
        "mjx": int(second.sum()),
        "agree": int((first == second).sum()),
        "episodes": episodes,
        "seconds": round(time.monotonic() - began, 1),
    }


def main(options: Options) -> int:
    configure_jax("mjx")
    done = [json.loads(x) for x in options.out.read_text().splitlines()] if options.out and options.out.exists() else []
    results = {result["task"]: result for result in done}
    for name in select_tasks(options.tasks):
        if name not in results:
            results[name] = compare(name, options.episodes)
            if options.out:
                with options.out.open("a") as file:
                    file.write(json.dumps(results[name]) + "\n")
        result = results[name]
        print(f"{name:36} " + "  ".join(f"{key} {value}" for key, value in result.items() if key != "task"), flush=True)
    return int(any(result["agree"] < 0.95 * result["episodes"] for result in results.values()))


if __name__ == "__main__":
    with fail_with_message():
        sys.exit(main(tyro.cli(Options, description=__doc__)))
