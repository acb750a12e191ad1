"""From recorded episodes to batches: shuffled, endless, split over processes, and resumable to the exact sample."""

import operator
from collections.abc import Callable
from typing import Any, SupportsIndex

import grain
import numpy as np

from data_pipelines.episodes import EpisodeReader
from data_pipelines.records import Frame

Sample = dict[str, Any]
ToSample = Callable[[Frame, np.random.Generator], Sample]


class FrameSource(grain.sources.RandomAccessDataSource[Frame]):
    """The frames of a reader as a grain random-access source."""

    def __init__(self, reader: EpisodeReader):
        self._reader = reader

    def __len__(self) -> int:
        return self._reader.num_frames

    def __getitem__(self, record_key: SupportsIndex) -> Frame:
        return self._reader.frame(operator.index(record_key))

    def __repr__(self) -> str:
        # grain stores this text with an iterator's state to recognise the source on restore.
        return f"FrameSource(tasks={self._reader.tasks}, frames={len(self)})"


def frame_arrays(frame: Frame, rng: np.random.Generator) -> Sample:
    """The default sample: all fields of the frame as arrays, nothing random; instruction and task as text arrays."""
    del rng
    return {name: np.asarray(value) for name, value in frame.items()}


def make_loader(
    reader: EpisodeReader,
    to_sample: ToSample | None = None,
    *,
    batch_size: int,
    seed: int,
    shuffle: bool = True,
    num_epochs: int | None = None,
    process_index: int = 0,
    process_count: int = 1,
    num_threads: int = 2,
) -> grain.DatasetIterator[Sample]:
    """Batches of samples; one epoch is every frame of every episode once, in an order that is new each epoch.

    to_sample: (frame, generator) -> arrays of shapes that are the same for all samples. The generator depends only on
    `seed` and the position in the stream, so a resumed run draws the same augmentation. Default: `frame_arrays`.
    num_epochs: None repeats for ever, and a batch may then span two epochs; otherwise a last partial batch is dropped.
    process_index, process_count: a batch of all processes together is cut into `process_count` equal parts, of
    `batch_size` samples each, and this process gets its part: the whole is the same however many share it.

    The iterator has ``get_state()`` and ``set_state(state)``: a JSON-able position, which counts batches. It is the
    same in every process, and good for another number of processes that share batches of the same size.
    """
    if to_sample is None and len(set(reader.num_arms.values())) > 1:
        raise ValueError(
            f"make_loader: expected tasks with one number of arms, got {reader.num_arms}; arrays of 1 and 2 arms do not"
            " batch: pass `to_sample` that turns poses into text of one length, or choose tasks of one kind"
        )
    if num_epochs is not None and num_epochs * reader.num_frames < batch_size * process_count:
        raise ValueError(
            f"make_loader: expected at least {batch_size * process_count} frames for one batch, got"
            f" {num_epochs * reader.num_frames}; make the batch smaller or record more episodes"
        )
    dataset = grain.MapDataset.source(FrameSource(reader)).seed(seed)
    if shuffle:
        dataset = dataset.shuffle()
    # The random map stands before the processes part, so that a sample is varied alike whoever reads it.
    dataset = dataset.repeat(num_epochs).random_map(to_sample or frame_arrays)
    batches = dataset.batch(batch_size, drop_remainder=True)
    if process_count > 1:
        batches = batches[process_index : len(batches) // process_count * process_count : process_count]
    options = grain.ReadOptions(num_threads=num_threads, prefetch_buffer_size=4 if num_threads else 0)
    return iter(batches.to_iter_dataset(options))
