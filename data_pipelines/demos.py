"""Scripted-expert demonstrations: python -m data_pipelines.demos OUT --tasks lamp_on put_rubbish_in_bin --episodes 100

Runs the tasks' scripted experts in C MuJoCo, several tasks at a time, and replaces the episodes that fail by further
seeds. An episode is kept if it succeeded and if its recorded keyframes, replayed from its seed, succeed too.
Interrupted, it continues with the first missing shard; every shard depends only on the options and its own number, so
the result is the same.
"""

import contextlib
import dataclasses
import os
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from tqdm import tqdm

from data_pipelines.episodes import ShardEntry, check_shard, existing_shards, shard_name, write_index, write_shard
from data_pipelines.processes import complete_in_processes
from data_pipelines.records import Episode, make_episode, mark_missing
from dsvla_jax.command_line import configure_jax, ended_by_sigterm, fail_with_message, parse_options
from dsvla_jax.encoding.keypoints import replay_latch
from dsvla_jax.errors import UserError
from dsvla_jax.files import hold_folder
from dsvla_jax.json_values import Json
from dsvla_jax.perception.simulator import keypoint_source
from dsvla_jax.ranges import Range, at_least, check_fields, require
from dsvla_jax.sim.cameras import FRONT, check_cameras
from dsvla_jax.sim.environment import Environment
from dsvla_jax.sim.physics import SimState
from dsvla_jax.sim.seeds import episode_keys
from dsvla_jax.sim.shifts import check_shifts
from dsvla_jax.sim.tasks import get_task, select_tasks
from dsvla_jax.types import Action, Observation

# Attempts, as a multiple of the episodes asked for, after which an expert counts as broken.
MAX_ATTEMPTS = 10

# Settings that older folders did not record; an index omits them when they have these values.
UNRECORDED: dict[str, Json] = {"cameras": [FRONT], "shift": []}

# (first number, count) -> an episode for each number of the seed stream, None for a failure.
Demonstrate = Callable[[int, int], Sequence[Episode | None]]


@dataclasses.dataclass(frozen=True)
class Settings:
    """What decides the contents of a shard, besides its task and number."""

    image_size: int = 96
    """Rendered pixels a side."""
    cameras: tuple[str, ...] = (FRONT,)
    """Names of the cameras to record, in this order: front, left_shoulder, right_shoulder, overhead and wrist, of two
    arms wrist_left and wrist_right."""
    seed: int = 0
    """Seed; another number gives other demonstrations."""
    split: Literal["train", "validation", "eval"] = "train"
    """The stream of seeds; evaluations start from those of `eval`."""
    perturb: float = 0.03
    """Most metres an axis by which the arms miss a keyframe, so that observations off the expert's path are recorded,
    with the expert's next keyframe as the target."""
    perturb_probability: float = 0.5
    """How often a keyframe is missed on purpose."""
    keypoints: Literal["segmentation", "oracle"] = "segmentation"
    """Those found in the first picture by the simulator's masks and the depth on them, or the task's own points. An
    attempt in which an object is not seen is replaced like one that failed."""
    shift: tuple[str, ...] = ()
    """Ways in which scenes differ from the default ones (paper, Table 4): instance, position, background, camera."""
    batch: int = 20
    """Episodes simulated at a time, and attempts a shard."""

    def __post_init__(self) -> None:
        check_fields(self, "", **self._ranges())
        check_shifts(self.shift)

    def as_json(self) -> dict[str, Json]:
        """Returns all settings, tuples as lists."""
        return {
            name: list(value) if isinstance(value, tuple) else value for name, value in dataclasses.asdict(self).items()
        }

    def as_written(self) -> dict[str, Json]:
        """Returns the settings that an index records, see `UNRECORDED`."""
        return {
            name: value for name, value in self.as_json().items() if name not in UNRECORDED or value != UNRECORDED[name]
        }

    def _ranges(self) -> dict[str, Range]:
        return {
            "image_size": at_least(1),
            "seed": at_least(0),
            "perturb": at_least(0),
            "perturb_probability": at_least(0, 1),
            "batch": at_least(1),
        }


@dataclasses.dataclass(frozen=True)
class Options(Settings):
    """Options of the command line."""

    out: tyro.conf.Positional[Path] = dataclasses.field(kw_only=True)
    """The folder to write; a folder with the same options is continued."""
    tasks: tuple[str, ...] = dataclasses.field(kw_only=True)
    """Names of tasks, all, single_arm or dual_arm."""
    episodes: int = 100
    """Successful demonstrations a task."""
    workers: int = os.cpu_count() or 1
    """Processes, each at work on one task."""

    def _ranges(self) -> dict[str, Range]:
        return {**super()._ranges(), "episodes": at_least(1), "workers": at_least(1)}


class ScriptedExpert:
    """Demonstrations of one task by its scripted expert."""

    def __init__(self, task: str, settings: Settings) -> None:
        self.task = get_task(task)
        self.settings = settings
        self.environment = Environment(
            self.task,
            physics="mujoco",
            image_size=settings.image_size,
            cameras=settings.cameras,
            shifts=settings.shift,
        )
        self._replay_latch = jax.jit(jax.vmap(replay_latch))

    def __call__(self, start: int, count: int) -> list[Episode | None]:
        """Episodes start .. start + count - 1 of the stream of seeds; None where the expert did not succeed."""
        environment, settings = self.environment, self.settings
        start_state = environment.reset(episode_keys(settings.seed, settings.split, self.task.name, start, count))
        state = start_state
        plan = environment.expert(state)
        poses, grippers = np.asarray(plan.pose), np.asarray(plan.gripper_open)  # (B, M, A, 7), (B, M, A)
        generators = [
            np.random.default_rng([settings.seed, zlib.crc32(self.task.name.encode()), start + i]) for i in range(count)
        ]
        ways = [generator.integers(len(self.task.instructions)) for generator in generators]
        instructions = environment.instructions(state, np.array(ways))
        missed = poses.copy()
        missed[..., :3] += np.stack([self._misses(rng, poses.shape[1]) for rng in generators])

        observations, before_success = [], []
        for m in range(poses.shape[1]):
            observations.append(jax.tree.map(np.asarray, environment.observe(state)))
            before_success.append(~np.asarray(environment.success(state)))
            state = environment.step(
                state, Action(pose=jnp.asarray(missed[:, m]), gripper_open=jnp.asarray(grippers[:, m]))
            )
        # Success after so many keyframes of the plan, none of them missed: bool (B, M + 1).
        unmissed = environment.follow(start_state, plan)
        replayed = np.stack([np.asarray(environment.success(after)) for after in unmissed], axis=1)
        keypoints, unseen = self._keypoints(start_state, observations[0])
        positions = np.stack([observation.robot.pose[..., :3] for observation in observations], axis=1)
        active = np.asarray(self._replay_latch(positions, keypoints))
        good = np.asarray(environment.success(state)) & ~np.asarray(state.ik_failed) & ~np.asarray(state.diverged)
        good &= ~unseen

        episodes: list[Episode | None] = []
        for i in range(count):
            # Nobody acts after success, so nothing is recorded after it.
            frames = int(np.sum([running[i] for running in before_success]))
            if not good[i] or frames == 0 or not replayed[i, frames]:
                episodes.append(None)
                continue
            seen = [jax.tree.map(lambda x, i=i: x[i], observation) for observation in observations[:frames]]
            episodes.append(
                make_episode(
                    task=self.task.name,
                    instruction=instructions[i],
                    seed=start + i,
                    pictures=[replace(x.pictures, depth=mark_missing(x.pictures.depth)) for x in seen],
                    pose=np.stack([x.robot.pose for x in seen]),
                    gripper_open=np.stack([x.robot.gripper_open for x in seen]),
                    target_pose=poses[i, :frames],
                    target_gripper=grippers[i, :frames],
                    keypoints=keypoints[i],
                    active_keypoint=active[i, :frames],
                    cameras=settings.cameras,
                )
            )
        return episodes

    def _keypoints(self, state: SimState, observation: Observation) -> tuple[np.ndarray, np.ndarray]:
        """Of the reset state and what is seen of it, (B, A, K, 3) metres, and bool (B,) where an object is not seen."""
        find = keypoint_source(self.settings.keypoints, self.environment)
        if find is None:
            points = np.asarray(self.environment.keypoints(state))
            return points, np.zeros(len(points), bool)
        points, problems = find(state)(state, observation)
        return points, np.array([bool(problem) for problem in problems])

    def _misses(self, rng: np.random.Generator, frames: int) -> np.ndarray:
        """How far each keyframe is missed, float (M, 1, 3) metres.

        The last one is never missed: nothing is observed after it. Two arms miss together, because apart they would
        drop what they hold between them.
        """
        limit = self.settings.perturb
        offsets = rng.uniform(-limit, limit, (frames, 1, 3))
        offsets *= rng.random((frames, 1, 1)) < self.settings.perturb_probability
        offsets[-1] = 0
        return offsets


def generate_demonstrations(
    folder: Path,
    tasks: Sequence[str],
    episodes: int = 100,
    *,
    demonstrator: Callable[[str, Settings], Demonstrate] = ScriptedExpert,
    workers: int = 1,
    progress: bool = True,
    **settings: object,
) -> None:
    """Makes sure that the folder holds at least `episodes` successful demonstrations of every task.

    What is there already with the same settings (fields of `Settings`) is kept; other settings raise DataError. Several
    callers may ask for the same folder: one makes what is missing, the others wait for it, and say so. SIGTERM ends the
    program with status 75; the same call continues.
    demonstrator: (task name, settings) -> the function that attempts episodes; made only when something is missing.
    workers: processes at work on a task each; 1 works in this one.
    """
    require(episodes > 0, "episodes", "at least 1", episodes)
    wanted = replace(Settings(), **settings)
    folder = Path(folder)

    def shards() -> dict[str, ShardEntry]:
        found = existing_shards(folder, wanted.as_json(), assumed=UNRECORDED)
        return {entry["file"]: entry for entry in found}

    entries = shards()
    with contextlib.ExitStack() as stack:
        # A folder that holds everything may be read-only.
        if not all(is_complete(folder, task, episodes, entries, digest=False) for task in tasks):
            stack.enter_context(ended_by_sigterm("what was finished is kept, and the same command continues"))
            stack.enter_context(hold_folder(folder, "makes demonstrations there", wait=True))
            entries = shards()
        missing = [task for task in tasks if not is_complete(folder, task, episodes, entries)]
        _make_missing(folder, tasks, missing, episodes, wanted, entries, demonstrator, workers, progress)


def _make_missing(
    folder: Path,
    tasks: Sequence[str],
    missing: Sequence[str],
    episodes: int,
    wanted: Settings,
    entries: dict[str, ShardEntry],
    demonstrator: Callable[[str, Settings], Demonstrate],
    workers: int,
    progress: bool,
) -> None:
    """Writes the missing shards of the `missing` ones of the tasks, and the index after each."""
    made, attempts = 0, 0
    with tqdm(total=episodes * len(tasks), desc="demonstrations", unit="episode", disable=not progress) as bar:
        bar.update(episodes * (len(tasks) - len(missing)))

        def keep(entry: ShardEntry, successes: int, tried: int) -> None:
            nonlocal made, attempts
            made, attempts = made + successes, attempts + tried
            if tried:
                entries[entry["file"]] = entry
                write_index(folder, [entries[key] for key in sorted(entries)], wanted.as_written())
            bar.set_postfix_str(entry["task"])
            bar.update(len(entry["frames"]))

        jobs = [(folder, task, episodes, wanted, entries, demonstrator) for task in missing]
        bar.set_postfix_str("the first batch of each task compiles" if jobs else "")
        if workers > 1 and len(jobs) > 1:
            complete_in_processes(complete_task, jobs, min(workers, len(jobs)), keep, _start_worker)
        else:
            for job in jobs:
                complete_task(*job, keep)
    if attempts:
        size = sum(entry["bytes"] for entry in entries.values()) / 1e6
        rate = f"the experts succeeded in {made} of {attempts} attempts"
        tqdm.write(f"{folder}: {episodes} demonstrations each of {', '.join(tasks)}; {rate}; {size:.0f} MB in all")


def complete_task(
    folder: Path,
    task: str,
    episodes: int,
    wanted: Settings,
    entries: Mapping[str, ShardEntry],
    demonstrator: Callable[[str, Settings], Demonstrate],
    keep: Callable[[ShardEntry, int, int], None],
) -> None:
    """Writes the missing shards of one task.

    keep: called with (index entry, successes, attempts) of each shard, old or new; an old one took no attempts.
    """
    kept, number, demonstrate = 0, 0, None
    while kept < episodes:
        name = shard_name(task, number)
        entry, successes, attempts = entries.get(name), 0, 0
        if entry is None or not is_usable(folder, entry, episodes - kept):
            demonstrate = demonstrate or demonstrator(task, wanted)
            good = [x for x in demonstrate(number * wanted.batch, wanted.batch) if x is not None]
            chosen = good[: episodes - kept]
            entry = write_shard(folder, name, task, chosen, cut=len(chosen) < len(good))
            successes, attempts = len(good), wanted.batch
        keep(entry, successes, attempts)
        kept += len(entry["frames"])
        number += 1
        if kept < episodes and number * wanted.batch >= MAX_ATTEMPTS * max(episodes, wanted.batch):
            raise UserError(
                f"{task}: expected {episodes} successes of the scripted expert, got {kept} in"
                f" {number * wanted.batch} attempts; lower `perturb`, or correct the task's expert"
            )


def _start_worker() -> None:
    # C MuJoCo runs on the CPU anyway, and the first process may hold all memory of an accelerator.
    jax.config.update("jax_platforms", "cpu")
    configure_jax()


def is_complete(folder: Path, task: str, episodes: int, entries: Mapping[str, ShardEntry], digest: bool = True) -> bool:
    """Whether so many episodes of the task are there; with `digest` their files are read and compared too."""
    kept, number = 0, 0
    while kept < episodes:
        entry = entries.get(shard_name(task, number))
        if entry is None or not is_usable(folder, entry, episodes - kept, digest):
            return False
        kept += len(entry["frames"])
        number += 1
    return True


def is_usable(folder: Path, entry: ShardEntry, needed: int, digest: bool = True) -> bool:
    """Returns whether a shard of the index is there, and is long enough if it was cut short when fewer were asked for.

    Raises DataError for one that is there but damaged: no file is overwritten unasked.
    """
    if (entry.get("cut") and len(entry["frames"]) < needed) or not (folder / entry["file"]).exists():
        return False
    check_shard(folder, entry, digest)
    return True


def main(options: Options) -> None:
    """Generates what the options ask for."""
    tasks = select_tasks(options.tasks)
    for task in tasks:
        check_cameras(options.cameras, get_task(task).num_arms)
    settings = {field.name: getattr(options, field.name) for field in dataclasses.fields(Settings)}
    generate_demonstrations(options.out, tasks, options.episodes, workers=options.workers, **settings)


if __name__ == "__main__":
    with fail_with_message():
        parsed = parse_options(Options, prog="python -m data_pipelines.demos", description=__doc__)
        configure_jax()
        main(parsed)
