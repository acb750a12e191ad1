"""Import RLBench, PerAct or PerAct2 demonstrations: python -m data_pipelines.rlbench SRC OUT [--skip-bad]

SRC is a folder of tasks as RLBench's generators write it. OUT receives episodes that train.py reads with
--data.source episodes --data.folder OUT --data.tasks all. Interrupted, it continues with the first missing shard.
"""

import dataclasses
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro
from tqdm import tqdm

from data_pipelines.episodes import ShardNotes, check_shard, existing_shards, shard_name, write_index, write_shard
from data_pipelines.keyframes import (
    STILL,
    STOP_BUFFER,
    check_velocities,
    discover_keyframes,
    ever_rests,
    sample_starts,
)
from data_pipelines.recording import make_demonstration
from data_pipelines.records import Episode
from data_pipelines.rlbench.files import find_episodes, left_aside, read_recording
from dsvla_jax.command_line import configure_jax, fail_with_message, parse_options
from dsvla_jax.errors import DataError
from dsvla_jax.files import file_digest, hold_folder
from dsvla_jax.json_values import Json
from dsvla_jax.ranges import Range, at_least, check_fields, require

EPISODES_PER_SHARD = 20


@dataclasses.dataclass(frozen=True)
class Settings:
    """What decides the contents of an imported folder, besides its source."""

    cameras: Annotated[tuple[str, ...], tyro.conf.arg(aliases=("--camera",))] = ("front",)
    """The cameras to learn from, in this order."""
    every_n: int = 10
    """Every how many observations a further sample starts, on the way to the next keyframe; 0: keyframes only."""
    keypoints: Literal["contacts", "none"] = "contacts"
    """RLBench records no keypoints. `contacts`: where each gripper opened or closed, and its last pose, looked up in
    the demonstration itself; none: prompts without the keypoint constraint."""
    still: float = STILL
    """Radians per second: where all joints are slower than that, the robot has stopped at a keyframe."""
    stop_buffer: int = STOP_BUFFER
    """Observations after a stop in which no further stop counts."""

    def __post_init__(self) -> None:
        distinct = len(set(self.cameras)) == len(self.cameras) and all(self.cameras)
        require(bool(self.cameras) and distinct, "cameras", "different names", self.cameras)
        check_fields(self, "", **self._ranges())

    def as_written(self) -> dict[str, Json]:
        """The settings that an index keeps: a single camera as `camera`, several as `cameras`."""
        fields = dataclasses.asdict(self)
        first, *others = fields.pop("cameras")
        return {"cameras": [first, *others], **fields} if others else {"camera": first, **fields}

    def _ranges(self) -> dict[str, Range]:
        return {"every_n": at_least(0), "still": at_least(0), "stop_buffer": at_least(0)}


@dataclasses.dataclass(frozen=True)
class Options(Settings):
    """Options of the command line."""

    source: tyro.conf.Positional[Path] = dataclasses.field(kw_only=True)
    """A folder of tasks, or of one task."""
    out: tyro.conf.Positional[Path] = dataclasses.field(kw_only=True)
    """The folder to write; a folder with the same options is continued."""
    tasks: tuple[str, ...] = ()
    """Names of tasks; all that are there if not given."""
    episodes: int | None = None
    """The first so many of each task; all if not given."""
    skip_bad: bool = False
    """Leave out damaged episodes, and list them, instead of stopping at the first."""

    def _ranges(self) -> dict[str, Range]:
        return {**super()._ranges(), "episodes": at_least(1)}


def contact_keypoints(pose: np.ndarray, gripper_open: np.ndarray) -> np.ndarray:
    """Where each arm's gripper changed, in time, and where it ended: (T, A, 7) and (T, A) -> (A, K, 3).

    The arm with fewer repeats its last.
    """
    arms = range(gripper_open.shape[1])
    changes = [np.flatnonzero(np.diff(gripper_open[:, arm])) + 1 for arm in arms]
    longest = max(len(frames) for frames in changes) + 1
    places = [[*frames, *[len(pose) - 1] * (longest - len(frames))] for frames in changes]
    return np.stack([pose[places[arm], arm, :3] for arm in arms])


def import_episode(folder: Path, task: str, number: int, settings: Settings) -> tuple[Episode, bool]:
    """One episode folder, and whether its joints ever rest. Raises DataError where it is damaged."""
    recording, joint_velocities = read_recording(folder, task, settings.cameras, keyframes_only=settings.every_n == 0)
    check_velocities(joint_velocities, folder)
    if settings.keypoints == "contacts":
        points = contact_keypoints(recording.pose, recording.gripper_open)
        recording = dataclasses.replace(recording, keypoints=points)
    keyframes = discover_keyframes(recording.gripper_open, joint_velocities, settings.still, settings.stop_buffer)
    fix = (
        "this camera does not see where the grippers act: choose another --cameras, or import without keypoints "
        "(--keypoints none); if it should see it, its matrix is wrong"
    )
    samples = sample_starts(keyframes, settings.every_n)
    return make_demonstration(recording, samples, number, folder, fix), ever_rests(joint_velocities, settings.still)


def origin_name(task: str, folder: Path) -> str:
    """An episode's name, wherever its task's folder is."""
    return "/".join([task, *folder.parts[-3:]])


def origin_of(task: str, folders: Sequence[Path]) -> dict[str, str | None]:
    """By name, what tells episodes from others of that name, such as another split's: a digest of what was felt.

    None stands for what was left out.
    """
    paths = {origin_name(task, folder): folder / "low_dim_obs.pkl" for folder in folders}
    return {name: file_digest(path) if path.is_file() else None for name, path in paths.items()}


def require_same_origin(out: Path, origin: dict[str, str | None], before: dict[str, str | None]) -> None:
    """Raises DataError if an episode that is in `out` is another one than that of the same name now."""
    for name, digest in origin.items():
        if digest is not None and before.get(name, digest) not in (digest, None):
            fix = "import each split into a folder of its own; if the data set was corrected, delete this one first"
            raise DataError(out, name, "the episode that was imported before", "another of that name", fix)


def import_demonstrations(
    source: Path,
    out: Path,
    settings: Settings,
    tasks: tuple[str, ...] = (),
    episodes: int | None = None,
    skip_bad: bool = False,
    progress: bool = True,
) -> list[dict[str, str]]:
    """Writes the folder `out`; returns what was left out, as {"episode", "reason"} each.

    Raises DataError for a damaged episode unless `skip_bad`; what was written before stays, and is gone on
    with by calling again, which also tries again what was left out.
    """
    found = find_episodes(source)
    if missing := set(tasks) - set(found):
        raise DataError(source, "tasks", f"some of {', '.join(found)}", ", ".join(sorted(missing)), "choose others")
    chosen = {task: folders[:episodes] for task, folders in found.items() if not tasks or task in tasks}
    with hold_folder(out, "writes demonstrations there"):
        return _import_missing(chosen, out, settings, episodes, skip_bad, progress)


def _import_missing(
    chosen: dict[str, list[Path]], out: Path, settings: Settings, episodes: int | None, skip_bad: bool, progress: bool
) -> list[dict[str, str]]:
    """Writes the shards that `out` lacks of the episode folders of each task; returns what was left out."""
    wanted = {"importer": "rlbench", **settings.as_written()}
    # Folders from before these could be chosen.
    assumed = {"still": STILL, "stop_buffer": STOP_BUFFER}
    entries = {entry["file"]: entry for entry in existing_shards(out, wanted, assumed)}
    imported = {name: digest for entry in entries.values() for name, digest in entry.get("origin", {}).items()}
    with tqdm(total=sum(map(len, chosen.values())), desc="import", unit="episode", disable=not progress) as bar:
        for task, folders in chosen.items():
            bar.set_postfix_str(task)
            for start in range(0, len(folders), EPISODES_PER_SHARD):
                group = folders[start : start + EPISODES_PER_SHARD]
                name = shard_name(task, start // EPISODES_PER_SHARD)
                origin = origin_of(task, group)
                require_same_origin(out, origin, imported)
                if name in entries and (out / name).exists():
                    before = entries[name].get("origin", {})
                    whole = before == origin and None not in before.values()
                    # A wish for fewer episodes than before is none to lose the others.
                    if whole or (episodes is not None and origin.keys() < before.keys()):
                        check_shard(out, entries[name], digest=True)
                        bar.update(len(group))
                        continue
                good: list[Episode] = []
                skipped: list[dict[str, str]] = []
                restless, aside = 0, Counter[str]()
                for number, folder in enumerate(group, start):
                    try:
                        episode, rests = import_episode(folder, task, number, settings)
                        good.append(episode)
                        restless += not rests
                        aside.update(left_aside(folder, settings.cameras))
                    except DataError as error:
                        if not skip_bad:
                            raise
                        skipped.append({"episode": str(folder), "reason": str(error)})
                        origin[origin_name(task, folder)] = None
                    bar.update()
                notes: ShardNotes = {
                    "origin": origin,
                    "skipped": skipped,
                    "variations": sorted({episode.variation for episode in good if episode.variation is not None}),
                    "restless": restless,
                    "left_aside": dict(aside),
                }
                entries[name] = write_shard(out, name, task, good, **notes)
                write_index(out, [entries[key] for key in sorted(entries)], wanted)
    return [item for entry in entries.values() for item in entry.get("skipped", ())]


def main(options: Options) -> None:
    """Imports what the options ask for, and says what came of it."""
    settings = Settings(**{field.name: getattr(options, field.name) for field in dataclasses.fields(Settings)})
    skipped = import_demonstrations(
        options.source, options.out, settings, options.tasks, options.episodes, options.skip_bad
    )
    report(options.out, skipped)


def report(out: Path, skipped: Sequence[Mapping[str, Json]]) -> None:
    """Prints what the folder holds now and what was left out."""
    shards = existing_shards(out, {})
    counts: dict[str, int] = {}
    for entry in shards:
        counts[entry["task"]] = counts.get(entry["task"], 0) + len(entry["frames"])
    frames = sum(sum(entry["frames"]) for entry in shards)
    variations = {(entry["task"], number) for entry in shards for number in entry.get("variations", ())}
    listed = ", ".join(f"{task} {count}" for task, count in counts.items())
    print(f"{out}: {sum(counts.values())} episodes ({listed}) of {len(variations)} variations, {frames} samples")
    if restless := sum(entry.get("restless", 0) for entry in shards):
        print(f"in {restless} of them the joints never rest: keyframes are changes of a gripper and the end (--still)")
    aside = sum((Counter(entry.get("left_aside", {})) for entry in shards), Counter[str]())
    if aside:
        names = ", ".join(f"{name} ({count})" for name, count in sorted(aside.items()))
        print(f"left aside, folder (episodes): {names}; masks do not say of which object they are")
    if skipped:
        print(f"left out {len(skipped)} damaged episodes:")
        for item in skipped:
            print(f"  {item['reason']}")


if __name__ == "__main__":
    with fail_with_message():
        parsed = parse_options(Options, prog="python -m data_pipelines.rlbench", description=__doc__)
        configure_jax()
        main(parsed)
