"""Batches of a mixture, with the interface of ``data_pipelines.loader``: an iterator with a position to save."""

import dataclasses
import json
import operator
import os
import sys
from collections.abc import Iterator
from typing import SupportsIndex, cast

import grain
import numpy as np

from data_pipelines.oxe.mixture import ENDLESS, EncodedSample, MixtureSource
from data_pipelines.oxe.samples import make_batcher
from data_pipelines.oxe.scale import MixtureScale
from dsvla_jax.data_config import OxeConfig
from dsvla_jax.encoding.config import EncodingConfig
from dsvla_jax.encoding.displacement import DisplacementScale
from dsvla_jax.encoding.text import Tokenizer, check_words
from dsvla_jax.errors import DataError, UserError
from dsvla_jax.json_values import Json
from dsvla_jax.types import Example


class OxeLoader(Iterator[Example[np.ndarray]]):
    """Endless batches. `scale`: what displacements are binned over, None for absolute targets."""

    def __init__(
        self,
        config: OxeConfig,
        encoding: EncodingConfig,
        tokenizer: Tokenizer,
        *,
        batch_size: int,
        seed: int,
        process_index: int = 0,
        process_count: int = 1,
        num_threads: int | None = None,
        progress: bool = True,
    ) -> None:
        """batch_size: of one process; processes take the numbers of the one stream in turns.

        num_threads: that make batches beside the caller, 0 for none; by default one a processor and at most 4, since
            what a batch needs of Python itself keeps others waiting.
        The order depends on `seed` and the config only: not on processes, threads or where a run was interrupted.
        """
        num_threads = min(4, os.cpu_count() or 1) if num_threads is None else num_threads
        ahead = 2 * num_threads
        self.source = MixtureSource(config, seed, progress, max(ahead, 1) * batch_size * process_count)
        command = f"python -m data_pipelines.oxe vocabulary OUT --folder {config.folder} --mixture"
        check_words(config.folder, self.source.words, tokenizer, f"{command} {' '.join(config.mixture)}")
        if encoding.use_points:
            flat = [item.dataset.name for item in self.source.datasets if item.dataset.depth is None]
            if flat:
                raise UserError(
                    f"encoding.use_points: {', '.join(flat)} have no calibrated depth; set it to False, or choose"
                    " datasets that have"
                )
        mixture_scale = MixtureScale(self.source.datasets, self.source.shares) if config.target == "relative" else None
        self.scale: DisplacementScale | None = mixture_scale.scale if mixture_scale else None
        self._left_out = _LeftOut()
        for entry in self.source.left_out:
            self._left_out.report(entry)
        to_batch = make_batcher(config, encoding, tokenizer, mixture_scale, seed, self._left_out.report)
        batches = grain.MapDataset.source(_Batches(self.source, batch_size, process_index, process_count))
        options = grain.ReadOptions(num_threads=num_threads, prefetch_buffer_size=ahead)
        dataset = batches.map(to_batch).to_iter_dataset(options)
        self._batches = cast(grain.DatasetIterator[Example[np.ndarray]], iter(dataset))

    @property
    def num_samples(self) -> int:
        """Of all datasets, each once."""
        return self.source.num_samples

    @property
    def left_out(self) -> list[tuple[str, str]]:
        """Records and frames that were skipped so far, and why."""
        return self._left_out.listed()

    def __next__(self) -> Example[np.ndarray]:
        return next(self._batches)

    def get_state(self) -> dict[str, Json]:
        """JSON: the position, the data that it belongs to, and the scale that a policy un-normalises with."""
        scale = dataclasses.asdict(self.scale) if self.scale else None
        return {"position": self._batches.get_state(), "data": repr(self.source), "scale": scale}

    def set_state(self, state: dict[str, Json]) -> None:
        """Goes on from a position. Raises DataError where the data, the mixture or the scale are others than then."""
        then, now = (json.loads(json.dumps(one)) for one in (state, self.get_state()))
        for part in ("data", "scale"):
            if then.get(part) != now[part]:
                fix = "put the same data back, or start a new run"
                raise DataError("saved position", part, str(then.get(part)), str(now[part]), fix)
        position = state["position"]
        assert isinstance(position, dict)
        self._batches.set_state(position)


class _Batches(grain.sources.RandomAccessDataSource[list[tuple[int, EncodedSample]]]):
    """Frames by the number of the batch, each with its number in the stream. All processes' parts make a run of it."""

    def __init__(self, source: MixtureSource, size: int, process_index: int, process_count: int) -> None:
        self._source, self._size, self._index, self._count = source, size, process_index, process_count

    def __len__(self) -> int:
        return ENDLESS

    def __getitem__(self, record_key: SupportsIndex) -> list[tuple[int, EncodedSample]]:
        first = operator.index(record_key) * self._size * self._count + self._index
        numbers = range(first, first + self._size * self._count, self._count)
        return [(number, self._source[number]) for number in numbers]

    def __repr__(self) -> str:
        # grain keeps this text with an iterator's position, and compares it on the way back.
        return f"batches of {self._size * self._count} of {self._source!r}"


class _LeftOut:
    """Records and frames that were skipped, each with the reason, in the order in which they were found."""

    def __init__(self) -> None:
        self._entries: dict[tuple[str, str], None] = {}

    def report(self, entry: tuple[str, str]) -> None:
        """Keeps an entry and prints it on standard error, unless it is known."""
        if entry not in self._entries:
            self._entries[entry] = None
            print(f"left out ({len(self._entries)}): {entry[0]}: {entry[1]}", file=sys.stderr)

    def listed(self) -> list[tuple[str, str]]:
        """Record and reason of each."""
        return list(self._entries)
