"""Scripted experts: >= 98 of 100 fresh seeds a task; no success at reset, idle, or by a wrong variation (8 minutes).

Usage: python -m benchmarks.expert_success [--tasks lamp_on ...] [--episodes 100] [--film FOLDER]

--film writes a picture a task: the first four episodes, a row each, at reset and after every keyframe.
"""

import dataclasses
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from dsvla_jax.command_line import configure_jax, fail_with_message
from dsvla_jax.files import write_picture
from dsvla_jax.sim.environment import Environment
from dsvla_jax.sim.seeds import episode_keys
from dsvla_jax.sim.tasks import select_tasks
from dsvla_jax.types import Action


@dataclasses.dataclass(frozen=True)
class Options:
    """Which experts, and on how many seeds."""

    tasks: tuple[str, ...] = ("all",)
    episodes: int = 100
    film: Path | None = None
    shift: tuple[str, ...] = ()
    """Test conditions (see dsvla_jax.sim.shifts) under which to look at the experts; no rate is required of them."""


def run_expert(environment: Environment, keys: jax.Array, film: Path | None = None) -> dict[str, np.ndarray]:
    """Which episodes succeed: by the expert, at reset, after the arms have been told to stay, and, where the task has
    variations, by the expert of another one."""
    start = environment.reset(keys)
    pose, gripper = environment.end_effector(start)
    stay = Action(jnp.repeat(pose[:, None], 3, 1), jnp.repeat(gripper[:, None], 3, 1))
    states = environment.follow(start, environment.expert(start))
    ends = {"expert": states[-1], "at reset": start, "idle": environment.follow(start, stay)[-1]}
    count = environment.task.variations
    if count > 1 and environment.task.exclusive:
        other = start.replace(variation=(start.variation + 1 + jnp.arange(len(keys)) % (count - 1)) % count)
        ends["wrong variation"] = environment.follow(start, environment.expert(other))[-1]
    if film:
        film.mkdir(parents=True, exist_ok=True)
        pictures = np.stack([np.asarray(environment.render(s).rgb)[:4] for s in states], axis=1)
        rows = [np.concatenate(list(row), axis=1) for row in pictures]
        write_picture(film / f"{environment.task.name}.png", np.concatenate(rows))
    return {name: np.asarray(environment.success(end)) for name, end in ends.items()}


def main(options: Options) -> int:
    configure_jax()
    short = False
    for name in select_tasks(options.tasks):
        # The validation stream: neither demonstrations nor evaluations use it.
        environment = Environment(name, image_size=224 if options.film else 96, shifts=options.shift)
        outcome = run_expert(environment, episode_keys(0, "validation", name, 0, options.episodes), options.film)
        counts = {key: int(value.sum()) for key, value in outcome.items()}
        wrong = sum(count for key, count in counts.items() if key != "expert")
        short |= counts["expert"] < 0.98 * options.episodes or wrong > 0
        failures = np.flatnonzero(~outcome["expert"])
        print(
            f"{name:36}"
            + "".join(f"  {key} {count}/{options.episodes}" for key, count in counts.items())
            + (f"  failed seeds {failures[:10].tolist()}" if len(failures) else ""),
            flush=True,
        )
    return int(short and not options.shift)


if __name__ == "__main__":
    with fail_with_message():
        sys.exit(main(tyro.cli(Options, description=__doc__)))
