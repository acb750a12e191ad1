"""Draws tasks and writes the page docs/tasks.md: python -m docs.gallery [--tasks lamp_on ...]

--tasks: which pictures to draw (a minute each); the page always lists all tasks.
"""

import dataclasses
import json
import re
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import tyro

from dsvla_jax.command_line import configure_jax, fail_with_message
from dsvla_jax.errors import UserError
from dsvla_jax.evaluation.pictures import film_strip
from dsvla_jax.files import write_picture
from dsvla_jax.sim.environment import Environment
from dsvla_jax.sim.seeds import episode_keys
from dsvla_jax.sim.tasks import TASKS, Task, select_tasks

SIZE, CANDIDATES = 224, 3  # pixels; episodes of which the first that succeeds is drawn
DOCS = Path(__file__).parent
GROUPS = {1: "Single-arm tasks", 2: "Dual-arm tasks"}
INTRODUCTION = """# The tasks

{count} tasks, named as in RLBench, built from primitive shapes. Each picture shows an episode at its start and when the
scripted expert has succeeded, as the front camera sees it. Objects are placed at random; a task with variations also
changes its colours, counts or places, and the instruction with them (the first variation is shown). Every task has
three to five ways to say it. "Keyframes" is how many the expert takes. [Adding a task](tasks_adding.md) takes one file.

This page and its pictures are made by `python -m docs.gallery`.
"""
TPU = """## On accelerators

Observing (128 px) and executing one keyframe of {episodes} episodes in MJX, compiled ahead of time for a TPU v5e 2x2
slice from a CPU by `python -m benchmarks.tpu_compile`: seconds to trace and lower and to compile there, and the memory
that arguments, results and temporaries take on each of the four chips (16 GiB). No TPU has run them.

| task | lower, s | compile, s | MiB a chip |
|---|---:|---:|---:|
"""


@dataclasses.dataclass(frozen=True)
class Options:
    """Which pictures to draw."""

    tasks: tuple[str, ...] = ("all",)


def draw(name: str) -> Path:
    """An episode of the first variation at reset and after the expert's last keyframe, side by side."""
    environment = Environment(name, image_size=SIZE)
    keys = episode_keys(1, "validation", name, 0, CANDIDATES)
    start = environment.reset(keys, variation=jnp.zeros(CANDIDATES, jnp.int32))
    states = environment.follow(start, environment.expert(start))
    succeeded = np.asarray(environment.success(states[-1]))
    if not succeeded.any():
        raise UserError(
            f"task {name!r}: its expert failed on all {CANDIDATES} episodes; see benchmarks.expert_success."
        )
    best = int(np.argmax(succeeded))
    frames = [np.asarray(environment.render(state).rgb[best]) for state in (states[0], states[-1])]
    path = DOCS / "images" / "tasks" / f"{name}.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_picture(path, film_strip(frames), compression=9)
    return path


def row(task: Task) -> str:
    """A task's line of the table."""
    words = sys.modules[f"dsvla_jax.sim.tasks.{task.name}"].__doc__ or ""
    meaning = re.sub(r"\s*RLBench[^:]*: \w+\.$", "", words.split("\n")[0])
    picture = f"images/tasks/{task.name}.png"
    shown = f"![{task.name}: at the start and at success]({picture})" if (DOCS / picture).exists() else ""
    cells = (
        shown,
        f"`{task.name}`<br>{meaning}",
        f'"{task.say(0)}"',
        task.variations,
        Environment(task).expert_keyframes,
    )
    return "| " + " | ".join(map(str, cells)) + " |"


def tpu_table(results: dict[str, dict[str, float]]) -> str:
    """What `benchmarks.tpu_compile` measured."""
    rows = [
        f"| `{name}` | {r['lower_seconds']:.0f} | {r['compile_seconds']:.0f} | {r['mib_a_chip']:.0f} |"
        for name, r in sorted(results.items())
    ]
    episodes = ", ".join(dict.fromkeys(f"{r['episodes']:,}" for r in results.values()))
    return TPU.format(episodes=episodes) + "\n".join(rows) + "\n"


def write_page() -> Path:
    """Writes the page of all tasks; returns its path."""
    parts = [INTRODUCTION.format(count=len(TASKS))]
    for arms, title in GROUPS.items():
        tasks = [task for _, task in sorted(TASKS.items()) if task.num_arms == arms]
        table = ["| start, success | task | instruction | variations | keyframes |", "|---|---|---|---:|---:|"]
        parts.append("\n".join([f"## {title} ({len(tasks)})", "", *table, *map(row, tasks), ""]))
    compiled = DOCS / "tpu_compile.json"
    if compiled.exists():
        parts.append(tpu_table(json.loads(compiled.read_text())))
    path = DOCS / "tasks.md"
    path.write_text("\n".join(parts))
    return path


def main(options: Options) -> None:
    """Draws the pictures of the tasks that the options name, and writes the page."""
    configure_jax()
    for name in select_tasks(options.tasks):
        print(draw(name), flush=True)
    print(write_page())


if __name__ == "__main__":
    with fail_with_message():
        main(tyro.cli(Options, description=__doc__))
