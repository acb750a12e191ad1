"""Prepares on the CPU what sections need: python -m benchmarks._accelerator.reference FOLDER SIZE [NAME ...].

Runs beside the first sections, in a process for which JAX has no other device than the CPU. Each thing is one file,
there once it is complete; why one could not be made stands in another file.
"""

import dataclasses
import pickle
import sys
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

from benchmarks._accelerator.sections import SIZES, Sizes, prepared_file, problem_file
from benchmarks._accelerator.simulation import EPISODE_TASK, starts
from benchmarks._accelerator.tiny import demonstrations
from benchmarks.mjx_agreement import outcomes
from data_pipelines.sources import open_demonstrations
from dsvla_jax.command_line import configure_jax
from dsvla_jax.files import write_bytes
from dsvla_jax.sim.environment import Environment
from dsvla_jax.suite_vocabulary import suite_tokenizer

# Metres an axis by which keyframes are missed at most, so that not all episodes succeed.
MISS = 0.04


def make_demonstrations(sizes: Sizes, folder: Path) -> str:
    """Writes the demonstrations of `tiny`, and says where they are."""
    data = demonstrations(folder, sizes.name)
    open_demonstrations(data, suite_tokenizer())
    return data.folder


def make_pictures(sizes: Sizes, _: Path) -> dict[str, Any]:
    """States of several tasks with their pictures."""
    pixels, tasks = sizes.picture_pixels, {}
    for task in sizes.picture_tasks:
        state = starts(task, pixels, "validation", sizes.pictures)
        tasks[task] = on_host({"state": state, "pictures": Environment(task, image_size=pixels).render(state)})
    return {"pixels": pixels, "tasks": tasks}


def make_episodes(sizes: Sizes, _: Path) -> dict[str, Any]:
    """Start states, plans that miss a little, and who succeeds in MJX and in C MuJoCo."""
    reference, environment = Environment(EPISODE_TASK), Environment(EPISODE_TASK, "mjx")
    start = starts(EPISODE_TASK, reference.image_size, "eval", sizes.compared)
    plan = reference.expert(start)
    missed = np.random.default_rng(0).uniform(-MISS, MISS, (*plan.pose.shape[:3], 3))
    plan = dataclasses.replace(plan, pose=plan.pose.at[..., :3].add(missed.astype(np.float32)))
    return {
        "task": EPISODE_TASK,
        **on_host({"start": start, "plan": plan}),
        "mjx": outcomes(environment, start, plan),
        "mujoco": outcomes(reference, start, plan),
    }


def on_host(tree: Any) -> Any:
    """The same tree of NumPy arrays."""
    return jax.tree.map(np.asarray, tree)


MAKERS: dict[str, Callable[[Sizes, Path], Any]] = {
    "demonstrations": make_demonstrations,
    "pictures": make_pictures,
    "episodes": make_episodes,
}


def main(folder: Path, sizes: Sizes, names: list[str]) -> int:
    """Makes the things of these names, one after the other."""
    configure_jax("mjx" if "episodes" in names else "mujoco")
    for name in names:
        file, problem = prepared_file(folder, name), problem_file(folder, name)
        try:
            content = pickle.dumps(MAKERS[name](sizes, folder))
        except (Exception, SystemExit) as error:
            traceback.print_exc()
            problem.write_text(f"{type(error).__name__}: {error}")
            continue
        write_bytes(file, content)
    return 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]), SIZES[sys.argv[2]], sys.argv[3:]))
