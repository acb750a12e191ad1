"""Write a folder of one's own demonstrations, for train.py and `python -m data_pipelines.inspect`."""

from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from data_pipelines.episodes import INDEX_FILE, read_index, shard_name, write_index, write_shard
from data_pipelines.keyframes import discover_keyframes, sample_starts
from data_pipelines.recording import Recording, check_recording, make_demonstration
from data_pipelines.records import Episode, decode_frame
from dsvla_jax.encoding.codec import PoseCodec
from dsvla_jax.errors import DataError
from dsvla_jax.observation_checks import check_surface

EPISODES_PER_SHARD = 20


class DemonstrationWriter:
    """Adds recordings to a folder, new or written before by this class.

        with DemonstrationWriter("data/mine") as writer:
            writer.add(recording, joint_velocities=velocities)

    A recording that is refused leaves the others as they are. What was added is on disk after every
    `EPISODES_PER_SHARD` recordings of a task, and at the end of the block, also where that ends in an error.

    every_n: further samples start at every so many observations between key poses; 0 for none.
    codec: the policy's; a pose outside of its box could not be written as text, and is refused.
    """

    def __init__(self, folder: Path | str, every_n: int = 10, codec: PoseCodec | None = None):
        self.folder, self.every_n, self.codec = Path(folder), every_n, codec or PoseCodec()
        self._settings = {"importer": "recordings"}
        self._entries: list[dict[str, Any]] = []
        self._waiting: dict[str, list[Episode]] = {}
        if (self.folder / INDEX_FILE).exists():
            index = read_index(self.folder)
            if index["settings"] != self._settings:
                fix = "choose a folder of its own"
                raise DataError(self.folder, "folder", "recordings", "demonstrations of another origin", fix)
            self._entries = index["shards"]
        self._counts = {entry["task"]: 0 for entry in self._entries}
        for entry in self._entries:
            self._counts[entry["task"]] += len(entry["frames"])

    def add(
        self,
        recording: Recording,
        *,
        keyframes: Sequence[int] | None = None,
        joint_velocities: np.ndarray | None = None,
    ) -> Episode:
        """Checks a recording and adds it; returns what was made of it.

        Args:
            keyframes: ascending numbers of the observations at key poses, the end included.
            joint_velocities: (T, A, J), radians per second: finds key poses where grippers change and all joints rest.

        Raises:
            DataError: the recording cannot be right, or neither or both of the above are given.
        """
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
            fix = "count observations from 0; the first is where the demonstration starts, not a key pose"
            raise DataError(where, "keyframes", f"ascending numbers from 1 to {count - 1}", str(numbers)[:80], fix)
        episode = make_demonstration(recording, sample_starts(numbers, self.every_n), number, where)
        self._check_box(episode, where)
        first = decode_frame(episode, 0)
        check_surface(first["depth"], first["intrinsics"], first["world_from_camera"], episode.keypoints, where)
        self._counts[recording.task] = number + 1
        self._waiting.setdefault(recording.task, []).append(episode)
        if len(self._waiting[recording.task]) == EPISODES_PER_SHARD:
            self._write(recording.task)
        return episode

    def _discover(self, recording: Recording, joint_velocities: np.ndarray | None, where: str) -> list[int]:
        gripper = np.asarray(recording.gripper_open)
        if joint_velocities is None:
            fix = "give joint velocities, from which key poses are found, or the key poses themselves"
            raise DataError(where, "keyframes", "them or joint_velocities", "neither", fix)
        shape = np.shape(joint_velocities)
        if len(shape) != 3 or shape[:2] != gripper.shape:
            fix = "give radians per second of each joint of each arm"
            raise DataError(where, "joint_velocities", f"{gripper.shape} and joints", str(shape), fix)
        if not np.isfinite(joint_velocities).all():
            raise DataError(where, "joint_velocities", "finite numbers", "non-finite ones", "give keyframes instead")
        return discover_keyframes(gripper, np.asarray(joint_velocities))

    def _check_box(self, episode: Episode, where: str) -> None:
        low, high = np.array(self.codec.low), np.array(self.codec.high)
        positions = np.concatenate([episode.pose, episode.target_pose])[..., :3].reshape(-1, 3)
        outside = (positions < low) | (positions > high)
        if outside.any():
            got = positions[outside.any(axis=1)][0].tolist()
            fix = "move the world's origin (poses, cameras and keypoints alike), or give the config's own codec"
            raise DataError(where, "pose", f"positions from {low.tolist()} to {high.tolist()}", f"{got}", fix)

    def _write(self, task: str) -> None:
        episodes = self._waiting.pop(task)
        number = sum(entry["task"] == task for entry in self._entries)
        self._entries.append(write_shard(self.folder, shard_name(task, number), task, episodes))
        write_index(self.folder, sorted(self._entries, key=lambda entry: entry["file"]), self._settings)

    def close(self) -> None:
        """Writes what is not yet on disk."""
        for task in list(self._waiting):
            self._write(task)

    def __enter__(self) -> "DemonstrationWriter":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
