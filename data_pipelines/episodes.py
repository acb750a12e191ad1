"""Demonstration episodes on disk: array_record shards of episode records, and one ``index.json``.

A shard is an array_record file (random access by number) of ``records.pack_episode``. The index lists every shard with
its task, frame counts, size and sha256, because array_record itself reads a truncated file as an empty one.
"""

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Literal, NotRequired, TypedDict, Unpack

import numpy as np
from array_record.python import array_record_module  # pyright: ignore[reportAttributeAccessIssue]

from data_pipelines.records import (
    Episode,
    Frame,
    decode_frame,
    pack_episode,
    picture_size,
    select_cameras,
    unpack_episode,
)
from dsvla_jax.encoding.keypoints import REACHED_RADIUS
from dsvla_jax.errors import DataError
from dsvla_jax.files import file_digest, replacing, write_bytes, writing
from dsvla_jax.json_values import Json

FORMAT_NAME = "dsvla-episodes"
FORMAT_VERSION = 1
INDEX_FILE = "index.json"

_ONE_SET = "all episodes of a folder are seen by the same cameras: write a folder for each set of them"
_ONE_SIZE = "pictures of unlike sizes do not batch: resize them (intrinsics too), or write a folder for each size"


class ShardNotes(TypedDict, total=False):
    """What the writers of episodes keep in the index beside each shard. Other readers ignore it."""

    cut: bool
    """Whether more episodes succeeded than were asked for."""
    made_with: dict[str, Json]
    """How the keyframes of a recording were found."""
    origin: dict[str, str | None]
    """Imported episodes by name, see `data_pipelines.rlbench`; likewise the rest."""
    skipped: list[dict[str, str]]
    variations: list[int]
    restless: int
    left_aside: dict[str, int]


class ShardEntry(ShardNotes):
    """A shard in ``index.json``. Fields that are not required are not in folders of earlier versions."""

    file: str
    task: str
    num_arms: int
    frames: list[int]
    """Of each episode."""
    digests: NotRequired[list[str]]
    """Of each episode's record."""
    picture_size: list[int] | None
    """Height and width; None of a shard without episodes."""
    instructions: NotRequired[list[str]]
    bytes: int
    sha256: str
    cameras: NotRequired[list[str]]
    """Not of episodes with a single camera."""


class Index(TypedDict):
    """The contents of ``index.json``."""

    format: str
    version: int
    episodes: int
    frames: int
    reached_radius: NotRequired[float]
    settings: Mapping[str, Json]
    """How the data were made."""
    shards: list[ShardEntry]


class Contents(TypedDict):
    """What a reader gives: counts by task in their order, and a digest that tells equal counts apart."""

    tasks: dict[str, dict[str, int]]
    """By task: how many "episodes" and "frames"."""
    digest: str


class _ChosenShard(ShardEntry):
    """A shard from its episode `first` on; see `_marks`."""

    first: int
    marks: list[str] | list[int]


def shard_name(task: str, number: int) -> str:
    """The file of a task's shard."""
    return f"{task}-{number:05d}.array_record"


def write_shard(
    folder: Path, name: str, task: str, episodes: Sequence[Episode], **notes: Unpack[ShardNotes]
) -> ShardEntry:
    """Writes one shard under its final name only once it is complete; returns its index entry.

    episodes: of one task; may be empty. `notes` are kept in the entry.
    """
    folder.mkdir(parents=True, exist_ok=True)
    kinds = {(episode.task, episode.num_arms) for episode in episodes}
    if len(kinds) > 1 or any(kind[0] != task for kind in kinds):
        raise ValueError(
            f"shard {name}: expected episodes of {task} alike, got {sorted(kinds)}; write one shard a task"
        )
    cameras = sorted({episode.cameras for episode in episodes})
    if len(cameras) > 1:
        raise DataError(folder / name, "cameras", "the same for all", str(cameras), _ONE_SET)
    sizes = sorted({picture_size(png) for episode in episodes for png in (*episode.rgb_png, *episode.depth_png)})
    if len(sizes) > 1:
        raise DataError(folder / name, "picture size", "one (height, width) for all", str(sizes), _ONE_SIZE)
    digests = []
    with writing(folder / name), replacing(folder / name) as partial:
        # The pictures are compressed already; one record a chunk makes random access cheap.
        writer = array_record_module.ArrayRecordWriter(str(partial), "group_size:1,uncompressed")
        for episode in episodes:
            record = pack_episode(episode)
            digests.append(hashlib.blake2b(record, digest_size=8).hexdigest())
            writer.write(record)
        writer.close()
    entry: ShardEntry = {
        "file": name,
        "task": task,
        "num_arms": episodes[0].num_arms if episodes else 0,
        "frames": [episode.num_frames for episode in episodes],
        "digests": digests,
        "picture_size": list(sizes[0]) if sizes else None,
        "instructions": sorted({episode.instruction for episode in episodes}),
        "bytes": (folder / name).stat().st_size,
        "sha256": file_digest(folder / name),
        **notes,
    }
    if cameras and cameras[0]:
        entry["cameras"] = list(cameras[0])
    return entry


def write_index(folder: Path, shards: Sequence[ShardEntry], settings: Mapping[str, Json] | None = None) -> None:
    """Writes ``index.json`` atomically. `settings`: how the data were made, for whoever continues or reads them."""
    index: Index = {
        "format": FORMAT_NAME,
        "version": FORMAT_VERSION,
        "episodes": sum(len(shard["frames"]) for shard in shards),
        "frames": sum(sum(shard["frames"]) for shard in shards),
        "reached_radius": REACHED_RADIUS,
        "settings": settings or {},
        "shards": list(shards),
    }
    write_bytes(folder / INDEX_FILE, (json.dumps(index, indent=1, sort_keys=True) + "\n").encode())


def read_index(folder: Path) -> Index:
    """The checked contents of ``index.json``."""
    path = folder / INDEX_FILE
    fix = "write demonstrations there with `python -m data_pipelines.demos`, or import some (docs/data_own.md)"
    if not path.is_file():
        raise DataError(path, "file", "an index of demonstrations", "no such file", fix)
    try:
        index: Index = json.loads(path.read_text())
    except json.JSONDecodeError as error:
        raise DataError(path, "file", "JSON", str(error), fix) from error
    if not isinstance(index, dict) or index.get("format") != FORMAT_NAME:
        raise DataError(path, "format", FORMAT_NAME, repr(index)[:60], fix)
    if index.get("version") != FORMAT_VERSION:
        raise DataError(path, "version", str(FORMAT_VERSION), repr(index.get("version")), fix + " again")
    if (found := index.get("reached_radius", REACHED_RADIUS)) != REACHED_RADIUS:
        fix = "make the data again: the keypoint of each frame was chosen by another distance than a policy's will be"
        raise DataError(path, "reached_radius", f"{REACHED_RADIUS} m", f"{found}", fix)
    return index


def only_camera(index: Index) -> tuple[str, ...]:
    """The name of the camera of a folder with a single one, as the contents of its index say; empty if they do not."""
    settings = index["settings"]
    if isinstance(names := settings.get("cameras"), list) and names:
        return tuple(map(str, names))
    # The demonstrations of the simulator name their cameras unless it is the front camera alone.
    name = settings.get("camera") or ("front" if "perturb_probability" in settings else "")
    return (str(name),) if name else ()


def existing_shards(
    folder: Path, settings: Mapping[str, Json], assumed: Mapping[str, Json] | None = None
) -> list[ShardEntry]:
    """The index entries of a folder made with the same settings, for whoever continues it; none where there is none.

    assumed: what folders were made with that are older than a setting.
    Raises DataError where it was made with other settings.
    """
    if not (folder / INDEX_FILE).exists():
        return []
    index = read_index(folder)
    for field, value in settings.items():
        if (found := index["settings"].get(field, (assumed or {}).get(field))) != value:
            fix = "choose another folder, the same setting, or delete this folder"
            raise DataError(folder / INDEX_FILE, f"settings.{field}", f"{value!r} as asked for", repr(found), fix)
    return index["shards"]


def check_shard(folder: Path, entry: ShardEntry, digest: bool = False) -> None:
    """Raises DataError unless the shard is there with the size (and, if asked, the sha256) that the index tells."""
    path = folder / entry["file"]
    fix = "delete it and run the program that wrote it again: it continues where files are missing"
    if not path.is_file():
        raise DataError(path, "shard", f"{entry['bytes']} bytes", "no such file", fix)
    if path.stat().st_size != entry["bytes"]:
        raise DataError(path, "size", f"{entry['bytes']} bytes", f"{path.stat().st_size} (truncated copy?)", fix)
    if digest and (got := file_digest(path)) != entry["sha256"]:
        raise DataError(path, "sha256", entry["sha256"], got, fix)


def write_episodes(
    folder: Path | str, episodes: Iterable[Episode], per_shard: int = 20, settings: Mapping[str, Json] | None = None
) -> None:
    """Writes a whole data set at once: shards of up to `per_shard` episodes of one task, then the index.

    settings: how the data were made. Other writers must be kept out by the caller (`files.hold_folder`).
    """
    folder = Path(folder)
    by_task: dict[str, list[Episode]] = {}
    for episode in episodes:
        by_task.setdefault(episode.task, []).append(episode)
    shards = []
    for task, group in sorted(by_task.items()):
        for start in range(0, len(group), per_shard):
            name = shard_name(task, start // per_shard)
            shards.append(write_shard(folder, name, task, group[start : start + per_shard]))
    write_index(folder, shards, settings)


def _marks(shard: ShardEntry, first: int, count: int) -> list[str] | list[int]:
    """What tells episodes first .. first + count - 1 of a shard from others, as far as its index entry knows."""
    if "digests" in shard:
        return shard["digests"][first : first + count]
    # Of earlier versions. A shard that was cut short may be written again, longer.
    whole = count == len(shard["frames"]) and not shard.get("cut")
    return [shard["sha256"]] if whole else shard["frames"][first : first + count]


class EpisodeReader:
    """Random access to the episodes and frames of a folder.

    Opening checks that every shard is complete; ``verify="sha256"`` reads them all and compares digests too.
    Episodes and frames are numbered through all shards, task by task, in the order in which they were written.
    `num_arms` is by task, `instructions` are those of the shards, `cameras` the names of the cameras.
    tasks: which tasks, none twice; all if None. episodes: only the first of each task, this many; all if None. skip:
    leaves this many out before them. `fewer`: whether a task may have fewer. cameras: whose pictures to give, and in
    which order; all if None. "front" also stands for the only camera of a folder, whatever its name.
    """

    def __init__(
        self,
        folder: Path | str,
        tasks: Sequence[str] | None = None,
        episodes: int | None = None,
        skip: int = 0,
        fewer: bool = False,
        verify: Literal["size", "sha256"] = "size",
        cameras: Sequence[str] | None = None,
    ) -> None:
        self.folder = Path(folder)
        index = read_index(self.folder)
        self.cameras, self._chosen = self._choose_cameras(index, cameras)
        present = sorted({entry["task"] for entry in index["shards"] if entry["frames"]})
        if missing := set(tasks or ()) - set(present):
            raise DataError(
                self.folder,
                "tasks",
                f"some of {present}",
                str(sorted(missing)),
                "generate them, or choose others or all",
            )
        self.tasks = tuple(present if tasks is None else dict.fromkeys(tasks))
        self.settings = index["settings"]
        self._shards = [
            shard for task in self.tasks for shard in self._choose(index["shards"], task, episodes, skip, fewer)
        ]
        if not self._shards:
            raise DataError(self.folder, "shards", "at least one episode", "none", "generate demonstrations first")
        for entry in self._shards:
            check_shard(self.folder, entry, digest=verify == "sha256")
        sizes = {tuple(size) for entry in self._shards if (size := entry.get("picture_size"))}
        if len(sizes) > 1:
            raise DataError(self.folder, "picture size", "one (height, width) for all", str(sorted(sizes)), _ONE_SIZE)
        self.instructions = sorted({text for entry in self._shards for text in entry.get("instructions", ())})
        self.num_arms = {entry["task"]: entry["num_arms"] for entry in self._shards}
        self._first_episode = np.cumsum([0] + [len(entry["frames"]) for entry in self._shards])
        self._first_frame = np.cumsum([0] + [count for entry in self._shards for count in entry["frames"]])
        self._open: dict[int, array_record_module.ArrayRecordReader] = {}

    def _choose_cameras(self, index: Index, wanted: Sequence[str] | None) -> tuple[tuple[str, ...], tuple[int, ...]]:
        """Returns the names of the cameras to give, and their numbers among those of the folder.

        No name is known of some folders' only camera.
        """
        sets = {tuple(entry.get("cameras", ())) for entry in index["shards"] if entry["frames"]}
        if len(sets) > 1:
            raise DataError(self.folder, "cameras", "the same for all episodes", str(sorted(sets)), _ONE_SET)
        names = next(iter(sets), ()) or only_camera(index)
        if wanted is None or (len(names) <= 1 and tuple(wanted) == ("front",)):
            return names, tuple(range(max(len(names), 1)))
        if not wanted or not set(wanted) <= set(names) or len(set(wanted)) < len(wanted):
            there = ", ".join(names) or "one camera, whose name is not known"
            fix = "choose with data.cameras" if names else "leave data.cameras at front"
            raise DataError(self.folder, "cameras", f"some of {there}, each once", ", ".join(wanted) or "none", fix)
        return tuple(wanted), tuple(names.index(name) for name in wanted)

    def _choose(
        self, shards: Sequence[ShardEntry], task: str, episodes: int | None, skip: int, fewer: bool
    ) -> list[_ChosenShard]:
        """The task's shards, cut down to `episodes` of it after the first `skip`; `first` is where a shard begins."""
        mine = [shard for shard in shards if shard["task"] == task]
        count = max(sum(len(shard["frames"]) for shard in mine) - skip, 0)
        if episodes is not None and count < episodes and not fewer:
            fix = f"run `python -m data_pipelines.demos {self.folder} --tasks {task} --episodes {episodes}`"
            raise DataError(self.folder, f"episodes of {task}", f"at least {episodes}", str(count), fix)
        chosen: list[_ChosenShard] = []
        left = count if episodes is None else episodes
        for shard in mine:
            first = min(skip, len(shard["frames"]))
            frames = shard["frames"][first : first + left]
            chosen.append({**shard, "frames": frames, "first": first, "marks": _marks(shard, first, len(frames))})
            skip, left = skip - first, left - len(chosen[-1]["frames"])
        return [shard for shard in chosen if shard["frames"]]

    def contents(self) -> Contents:
        """What the reader gives, as JSON.

        It stays the same while the folder grows by episodes that this reader does not give.
        """
        tasks: dict[str, dict[str, int]] = {}
        for entry in self._shards:
            counts = tasks.setdefault(entry["task"], {"episodes": 0, "frames": 0})
            counts["episodes"] += len(entry["frames"])
            counts["frames"] += sum(entry["frames"])
        marks = [[entry["task"], *entry["marks"]] for entry in self._shards]
        return {"tasks": tasks, "digest": hashlib.blake2b(json.dumps(marks).encode(), digest_size=8).hexdigest()}

    def __getstate__(self) -> dict[str, object]:
        # Open files do not travel to worker processes; each opens its own.
        return {**self.__dict__, "_open": {}}

    def __len__(self) -> int:
        return int(self._first_episode[-1])

    @property
    def num_frames(self) -> int:
        """Frames of all episodes."""
        return int(self._first_frame[-1])

    def episode(self, number: int) -> Episode:
        """The episode of that number, pictures still encoded."""
        if not 0 <= number < len(self):
            raise IndexError(f"episode {number} of {self.folder}: expected 0 to {len(self) - 1}")
        shard = int(np.searchsorted(self._first_episode, number, side="right")) - 1
        path = self.folder / self._shards[shard]["file"]
        if shard not in self._open:
            self._open[shard] = array_record_module.ArrayRecordReader(str(path), options="readahead_buffer_size:0")
        place = number - int(self._first_episode[shard]) + self._shards[shard]["first"]
        (record,) = self._open[shard].read([place])
        episode = unpack_episode(record, f"{path}, episode {place}")
        if self._chosen == tuple(range(episode.num_cameras)):
            return episode
        return select_cameras(episode, self._chosen)

    def frames_of(self, task: str) -> range:
        """The numbers of a task's frames, which follow each other."""
        mine = [number for number, entry in enumerate(self._shards) if entry["task"] == task]
        first, last = self._first_episode[mine[0]], self._first_episode[mine[-1] + 1]
        return range(int(self._first_frame[first]), int(self._first_frame[last]))

    def locate(self, frame: int) -> tuple[int, int]:
        """(episode, frame in that episode) of a frame number."""
        if not 0 <= frame < self.num_frames:
            raise IndexError(f"frame {frame} of {self.folder}: expected 0 to {self.num_frames - 1}")
        episode = int(np.searchsorted(self._first_frame, frame, side="right")) - 1
        return episode, frame - int(self._first_frame[episode])

    def frame(self, number: int) -> Frame:
        """The frame of that number; only its own pictures are decoded."""
        episode_number, place = self.locate(number)
        episode = self.episode(episode_number)
        return decode_frame(episode, place, task_index=self.tasks.index(episode.task), episode_number=episode_number)
