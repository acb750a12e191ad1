"""From recorded episodes to batches: shuffled, endless, split over processes, and resumable to the exact sample."""

import json
import operator
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Generic, SupportsIndex, TypeVar, cast

import grain
import numpy as np

from data_pipelines.episodes import Contents, EpisodeReader
from data_pipelines.records import Frame
from dsvla_jax.errors import DataError
from dsvla_jax.json_values import Json

Sample = TypeVar("Sample")


class FrameSource(grain.sources.RandomAccessDataSource[Frame]):
    """The frames of a reader as a grain random-access source."""

    def __init__(self, reader: EpisodeReader) -> None:
        self._reader = reader

    def __len__(self) -> int:
        return self._reader.num_frames

    def __getitem__(self, record_key: SupportsIndex) -> Frame:
        return self._reader.frame(operator.index(record_key))

    def __repr__(self) -> str:
        return f"FrameSource(tasks={self._reader.tasks}, frames={len(self)})"


class EpisodeLoader(Iterator[Sample], Generic[Sample]):
    """Batches with a position that can be saved, together with what it is a position in; made by `make_loader`."""

    def __init__(self, batches: grain.DatasetIterator[Sample], folder: Path, contents: Contents) -> None:
        self._batches, self._folder, self._contents = batches, folder, contents

    def __next__(self) -> Sample:
        return next(self._batches)

    def get_state(self) -> dict[str, Json]:
        """JSON: the position, which counts batches, and the demonstrations that it is in (`EpisodeReader.contents`)."""
        return {"position": self._batches.get_state(), "data": cast(Json, self._contents)}

    def set_state(self, state: dict[str, Json]) -> None:
        """Continues from a position. Raises DataError if it was saved with other demonstrations than these.

        A state without them, as checkpoints of earlier versions hold, is taken at its word.
        """
        then, now = json.loads(json.dumps([state.get("data"), self._contents]))
        if "data" in state and then != now:
            fix = "restore those demonstrations, or start a new run with these (another --run)"
            if then["tasks"] == now["tasks"]:
                raise DataError(self._folder, "demonstrations", "those of the saved position", "as many others", fix)
            expected, got = _summary(then, now), _summary(now, then)
            raise DataError(self._folder, "demonstrations", f"{expected} as at the saved position", got, fix)
        position = state.get("position", state)
        assert isinstance(position, dict)
        self._batches.set_state(position)


def _summary(contents: Contents, other: Contents) -> str:
    """The tasks of one that the other has not in the same number."""
    tasks = {task: counts for task, counts in contents["tasks"].items() if other["tasks"].get(task) != counts}
    return ", ".join(f"{task} {n['episodes']} episodes ({n['frames']} frames)" for task, n in tasks.items()) or "none"


def make_loader(
    reader: EpisodeReader,
    to_sample: Callable[[Frame, np.random.Generator], Sample],
    *,
    batch_size: int,
    seed: int,
    shuffle: bool = True,
    num_epochs: int | None = None,
    process_index: int = 0,
    process_count: int = 1,
    num_threads: int = 2,
) -> EpisodeLoader[Sample]:
    """Batches of samples; one epoch is every frame of every episode once, in an order that is new each epoch.

    to_sample: (frame, generator) -> a pytree of arrays whose shapes are the same for all samples. The generator depends
    only on `seed` and the position in the stream, so a resumed run draws the same augmentation.
    num_epochs: None repeats for ever, and a batch may then span two epochs; otherwise a last partial batch is dropped.
    process_index, process_count: a batch of all processes together is cut into `process_count` equal parts, of
    `batch_size` samples each, and this process gets its part: the whole is the same however many share it.

    The position (`EpisodeLoader.get_state`) is the same in every process, and good for another number of processes that
    share batches of the same size.
    """
    if num_epochs is not None and num_epochs * reader.num_frames < batch_size * process_count:
        raise ValueError(
            f"make_loader: expected at least {batch_size * process_count} frames for one batch, got"
            f" {num_epochs * reader.num_frames}; make the batch smaller or record more episodes"
        )
    dataset = grain.MapDataset.source(FrameSource(reader)).seed(seed)
    if shuffle:
        dataset = dataset.shuffle()
    # The random map stands before the processes part, so that a sample is varied alike whoever reads it.
    dataset = dataset.repeat(num_epochs).random_map(to_sample)
    batches = dataset.batch(batch_size, drop_remainder=True)
    if process_count > 1:
        batches = batches[process_index : len(batches) // process_count * process_count : process_count]
    options = grain.ReadOptions(num_threads=num_threads, prefetch_buffer_size=4 if num_threads else 0)
    return EpisodeLoader(iter(batches.to_iter_dataset(options)), reader.folder, reader.contents())
