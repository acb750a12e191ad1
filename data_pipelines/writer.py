"""Write a folder of one's own demonstrations, for train.py and `python -m data_pipelines.inspect`."""

import math
import sys
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType

import numpy as np

from data_pipelines.episodes import INDEX_FILE, ShardEntry, read_index, shard_name, write_index, write_shard
from data_pipelines.keyframes import (
    STILL,
    STOP_BUFFER,
    check_velocities,
    discover_keyframes,
    ever_rests,
    sample_starts,
)
from data_pipelines.recording import Recording, check_recording, make_demonstration
from data_pipelines.records import Episode, decode_frame, picture_size
from dsvla_jax.encoding.codec import PoseCodec
from dsvla_jax.errors import DataError, UserError
from dsvla_jax.files import hold_folder
from dsvla_jax.observation_checks import check_surface
from dsvla_jax.ranges import at_least, require
from dsvla_jax.types import split_cameras

EPISODES_PER_SHARD = 20


class DemonstrationWriter:
    """Adds recordings to a folder, new or written before by this class.

        with DemonstrationWriter("data/mine") as writer:
            writer.add(recording, joint_velocities=velocities)

    One writer holds a folder at a time: another one, or an import, is refused until this one is closed or its process
    ends. A recording that is refused leaves the others as they are. What was added is on disk after every
    `EPISODES_PER_SHARD` recordings of a task, and at the end of the block, also if that ends in an error. Recordings
    that the disk has no room for stay in memory: free space, then call `close`.

    every_n: further samples start at every so many observations between keyframes; 0 for none.
    codec: the policy's; a pose outside of its box could not be written as text, and is refused.
    still, stop_buffer: radians per second below which all joints rest at a keyframe, and observations after such a stop
    in which no further one counts. These and every_n are kept with each shard in the index.
    """

    def __init__(
        self,
        folder: Path | str,
        every_n: int = 10,
        codec: PoseCodec | None = None,
        still: float = STILL,
        stop_buffer: int = STOP_BUFFER,
    ) -> None:
        require(every_n >= 0, "every_n", at_least(0), every_n)
        require(0 <= still < math.inf, "still", at_least(0), still)
        require(stop_buffer >= 0, "stop_buffer", at_least(0), stop_buffer)
        self.folder, self.every_n, self.codec = Path(folder), every_n, codec or PoseCodec()
        self.still, self.stop_buffer = still, stop_buffer
        self._discovered = self._restless = 0
        self._settings = {"importer": "recordings"}
        self._entries: list[ShardEntry] = []
        self._waiting: dict[str, list[Episode]] = {}
        self._lock = hold_folder(self.folder, "adds demonstrations there")
        try:
            self._entries = self._read_entries()
        except BaseException:
            self._lock.close()
            raise
        self._report_strays()
        self._sizes = {entry["task"]: tuple(entry["picture_size"]) for entry in self._entries if entry["picture_size"]}
        self._cameras = {tuple(entry.get("cameras", ())) for entry in self._entries}
        self._counts = {entry["task"]: 0 for entry in self._entries}
        for entry in self._entries:
            self._counts[entry["task"]] += len(entry["frames"])

    def _read_entries(self) -> list[ShardEntry]:
        if not (self.folder / INDEX_FILE).exists():
            return []
        index = read_index(self.folder)
        if index["settings"] != self._settings:
            fix = "choose a folder of its own"
            raise DataError(self.folder, "folder", "recordings", "demonstrations of another origin", fix)
        return index["shards"]

    def _report_strays(self) -> None:
        named = {entry["file"] for entry in self._entries}
        if strays := sorted({path.name for path in self.folder.glob("[!.]*.array_record")} - named):
            print(f"{self.folder}: not in its index, and left as it is: {', '.join(strays)}", file=sys.stderr)

    def add(
        self,
        recording: Recording,
        *,
        keyframes: Sequence[int] | None = None,
        joint_velocities: np.ndarray | None = None,
    ) -> Episode:
        """Checks a recording and adds it; returns what was made of it.

        Args:
            keyframes: ascending numbers of the observations at keyframes, the end included.
            joint_velocities: (T, A, J), radians per second: finds keyframes where grippers change and all joints rest.

        Raises:
            DataError: the recording cannot be right, or neither or both of the above are given.
        """
        if self._lock.closed:
            raise UserError(f"{self.folder}: this writer is closed; add recordings before, or open another one")
        number = self._counts.get(recording.task, 0)
        where = f"recording {number} of {recording.task!r}"
        check_recording(recording, where)
        if keyframes is None:
            keyframes = self._discover(recording, joint_velocities, where)
        elif joint_velocities is not None:
            raise DataError(where, "keyframes", "them or joint_velocities", "both", "leave one out")
        count = len(recording.pose)
        numbers = list(map(int, keyframes))
        if not numbers or numbers != sorted(set(numbers)) or numbers[0] < 1 or numbers[-1] >= count:
            fix = "count observations from 0; the first is where the demonstration starts, not a keyframe"
            raise DataError(where, "keyframes", f"ascending numbers from 1 to {count - 1}", str(numbers)[:80], fix)
        episode = make_demonstration(recording, sample_starts(numbers, self.every_n), number, where)
        self._check_box(episode, where)
        first = split_cameras(decode_frame(episode, 0).pictures)
        for name, one in zip(episode.cameras or ("",), first, strict=True):
            place, camera = f"{where}, camera {name}" if name else where, one.camera
            check_surface(one.depth, camera.intrinsics, camera.world_from_camera, episode.keypoints, place)
        self._check_cameras(episode, where)
        self._check_size(episode, where)
        self._counts[recording.task] = number + 1
        self._waiting.setdefault(recording.task, []).append(episode)
        if len(self._waiting[recording.task]) >= EPISODES_PER_SHARD:
            self._write(recording.task)
        return episode

    def _discover(self, recording: Recording, joint_velocities: np.ndarray | None, where: str) -> list[int]:
        gripper = np.asarray(recording.gripper_open)
        if joint_velocities is None:
            fix = "give joint velocities, from which keyframes are found, or the keyframes themselves"
            raise DataError(where, "keyframes", "them or joint_velocities", "neither", fix)
        shape = np.shape(joint_velocities)
        if len(shape) != 3 or shape[:2] != gripper.shape:
            fix = "give radians per second of each joint of each arm"
            raise DataError(where, "joint_velocities", f"{gripper.shape} and joints", str(shape), fix)
        velocities = np.asarray(joint_velocities)
        check_velocities(velocities, where)
        self._discovered += 1
        self._restless += not ever_rests(velocities, self.still)
        return discover_keyframes(gripper, velocities, self.still, self.stop_buffer)

    def _check_box(self, episode: Episode, where: str) -> None:
        low, high = np.array(self.codec.low), np.array(self.codec.high)
        positions = np.concatenate([episode.pose, episode.target_pose])[..., :3].reshape(-1, 3)
        outside = (positions < low) | (positions > high)
        if outside.any():
            got = positions[outside.any(axis=1)][0].tolist()
            fix = "move the world's origin (poses, cameras and keypoints alike), or give the config's own codec"
            raise DataError(where, "pose", f"positions from {low.tolist()} to {high.tolist()}", f"{got}", fix)

    def _check_cameras(self, episode: Episode, where: str) -> None:
        if self._cameras - {episode.cameras}:
            (known,) = self._cameras
            fix = "record with the same cameras, or write a folder for each set of them"
            expected, got = (", ".join(names) or "one camera" for names in (known, episode.cameras))
            raise DataError(where, "cameras", f"{expected}, as in {self.folder}", got, fix)
        self._cameras = {episode.cameras}

    def _check_size(self, episode: Episode, where: str) -> None:
        sizes = sorted({picture_size(png) for png in episode.rgb_png})
        expected = self._sizes.get(episode.task, sizes[0])
        if sizes != [expected]:
            fix = "resize the pictures (intrinsics too), or give the recording a task of its own"
            raise DataError(where, "picture size", f"{expected} for all of {episode.task!r}", str(sizes), fix)
        self._sizes[episode.task] = expected

    def _write(self, task: str) -> None:
        number = sum(entry["task"] == task for entry in self._entries)
        # A shard that no index names, of a writer that was killed before it wrote one, holds somebody's recordings.
        while (self.folder / shard_name(task, number)).exists():
            number += 1
        made_with = {"every_n": self.every_n, "still": self.still, "stop_buffer": self.stop_buffer}
        name = shard_name(task, number)
        entry = write_shard(self.folder, name, task, self._waiting[task], made_with=made_with)
        entries = sorted([*self._entries, entry], key=lambda entry: entry["file"])
        try:
            write_index(self.folder, entries, self._settings)
        except UserError:
            (self.folder / entry["file"]).unlink()
            raise
        self._entries = entries
        del self._waiting[task]

    def close(self) -> None:
        """Writes what is not yet on disk, and lets go of the folder."""
        for task in list(self._waiting):
            self._write(task)
        if self._restless and not self._lock.closed:
            print(
                f"{self.folder}: in {self._restless} of {self._discovered} recordings the joints never all rest (below "
                f"{self.still:g} rad/s): keyframes are changes of a gripper and the end",
                file=sys.stderr,
            )
        self._lock.close()

    def __enter__(self) -> "DemonstrationWriter":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
