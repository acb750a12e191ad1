"""What a policy sees: errors on held-out demonstrations and closed-loop success, with parts of its inputs withheld.

Usage: python -m benchmarks.seeing RUN [--tasks press_switch] [--episodes 25]

Errors are medians over held-out demonstrations, a row a task and keyframe: of the position, and of the rotation where
the demonstrations' rotations differ. Expected: at the first keyframe of every task whose rotation varies at most 10
degrees, and successes that owe at least 0.5 to the episode's own picture. The figures are part of RUN/eval/report.html.
"""

import contextlib
import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path

import jax
import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

import eval as evaluation
from data_pipelines.records import Episode, decode_frame
from data_pipelines.sources import open_held_out
from dsvla_jax.checkpoints.run import RunCheckpoints
from dsvla_jax.command_line import configure_jax, fail_with_message
from dsvla_jax.evaluation.seeing import KeyframeErrors, name_of, write_errors
from dsvla_jax.evaluation.withheld import Part, withholding
from dsvla_jax.experiment import load_experiment
from dsvla_jax.geometry.rotations import rotation_distance
from dsvla_jax.policies.interface import Policy
from dsvla_jax.policy import load_policy
from dsvla_jax.sim.tasks import select_tasks
from dsvla_jax.types import Observation

VIEWS: tuple[tuple[Part, ...], ...] = (
    (),
    ("colour",),
    ("depth",),
    ("colour", "depth"),
    ("keypoint",),
    ("own_pictures",),
)


@dataclasses.dataclass(frozen=True)
class Options:
    """Which run, and how much of it."""

    run: tyro.conf.Positional[Path]
    """The run folder."""
    tasks: tuple[str, ...] = ()
    """Names, all, single_arm or dual_arm; those the run was trained on if not given."""
    held_out: int = 10
    """Held-out demonstrations a task."""
    episodes: int = 25
    """Closed-loop episodes a task; 0 for none."""
    rotation_limit: float = 10.0
    """Degrees that the first keyframe's median error may have where rotations vary by more than that."""
    picture_share: float = 0.5
    """The least part of success that must be lost with another episode's pictures."""


def held_out_errors(policy: Policy, task: str, episodes: Sequence[Episode]) -> list[KeyframeErrors]:
    """Compares answers to every recorded frame of a task's episodes with the demonstrator's next keyframe."""
    found = []
    for keyframe in range(max(episode.num_frames for episode in episodes)):
        frames = [decode_frame(episode, keyframe) for episode in episodes if episode.num_frames > keyframe]
        if len(frames) < 2:
            continue
        seen = jax.tree.map(lambda *x: np.stack(x), *[Observation(f.pictures, f.robot, f.past) for f in frames])
        near = np.stack([frame.keypoint for frame in frames]) if len(frames[0].keypoint) else None
        wanted, gripper = (np.stack([getattr(f.target, name) for f in frames]) for name in ("pose", "gripper_open"))
        apart = np.degrees(rotation_distance(wanted[:, None, :, 3:], wanted[None, :, :, 3:]))
        varies = np.median(apart[np.triu_indices(len(frames), 1)], axis=0).max()
        for parts in VIEWS:
            action, _ = withholding(policy.act, parts)(seen, [frame.instruction for frame in frames], near)
            off = 100 * np.linalg.norm(action.pose[..., :3] - wanted[..., :3], axis=-1)
            turn = np.degrees(rotation_distance(action.pose[..., 3:], wanted[..., 3:]))
            right = (np.asarray(action.gripper_open) == gripper).mean(axis=0).min()
            position, rotation = (float(np.median(x, axis=0).max()) for x in (off, turn))
            found.append(KeyframeErrors(task, keyframe + 1, parts, position, rotation, float(right), float(varies)))
    return found


def closed_loop(options: Options, tasks: Sequence[str]) -> dict[tuple[Part, ...], dict[str, float]]:
    """Success rates by what is withheld and task; those that the run's results already hold are not measured again."""
    rates: dict[tuple[Part, ...], dict[str, float]] = {}
    # The plain evaluation is the last, and its report the one that stays.
    for parts in reversed(VIEWS):
        asked = evaluation.Options(
            options.run, tasks=tuple(tasks), episodes=options.episodes, withhold=parts, skip_finished=True
        )
        evaluation.main(asked)
        results = [one for one in evaluation.compared(options.run, asked) if one.episode < options.episodes]
        by_task = {task: [one.success for one in results if one.task == task] for task in tasks}
        rates[parts] = {task: float(np.mean(successes)) for task, successes in by_task.items()}
    return rates


def main(options: Options) -> int:
    """Prints the figures; 0 if none falls short."""
    experiment = load_experiment(options.run / "config.json")
    tasks = select_tasks(options.tasks or experiment.data.tasks)
    with contextlib.closing(RunCheckpoints(options.run, read_only=True)) as checkpoints:
        step, digest = checkpoints.identify()
    policy = load_policy(options.run, step=step)
    data = dataclasses.replace(experiment.data, tasks=tasks)
    reader = open_held_out(data, policy.tokenizer, options.held_out)
    episodes = [reader.episode(number) for number in range(len(reader))]
    errors = []
    for task in tasks:
        errors += held_out_errors(policy, task, [episode for episode in episodes if episode.task == task])
    table = Table("task", "keyframe", *map(name_of, VIEWS), title="median error: position cm; rotation degrees")
    for task, keyframe in dict.fromkeys((one.task, one.keyframe) for one in errors):
        row = [one for one in errors if (one.task, one.keyframe) == (task, keyframe)]
        table.add_row(task, str(keyframe), *(one.describe() for one in row))
    console = Console()
    console.print(table)
    write_errors(options.run / "eval", digest, errors)

    limit = options.rotation_limit
    first = [one for one in errors if one.keyframe == 1 and not one.withheld and one.varies_degrees > limit]
    short = [f"{one.task} {one.rotation_degrees:.0f} degrees" for one in first if one.rotation_degrees > limit]
    print(f"first keyframes that turn by more than {limit:g} degrees off: {', '.join(short) or 'none'} of {len(first)}")
    if options.episodes:
        rates = closed_loop(options, tasks)
        shown = Table("task", *map(name_of, VIEWS), title=f"success in {options.episodes} episodes")
        for task in tasks:
            shown.add_row(task, *(f"{rates[parts][task]:.2f}" for parts in VIEWS))
        means = {parts: float(np.mean(list(rates[parts].values()))) for parts in VIEWS}
        shown.add_section()
        shown.add_row("mean", *(f"{means[parts]:.3f}" for parts in VIEWS))
        console.print(shown)
        owed = means[()] - means[("own_pictures",)]
        print(f"success lost with another episode's pictures: {owed:.3f} (at least {options.picture_share})")
        short += ["pictures"] * (owed < options.picture_share)
    return int(bool(short))


if __name__ == "__main__":
    with fail_with_message():
        parsed = tyro.cli(Options, description=__doc__)
        configure_jax()
        sys.exit(main(parsed))
