"""A tfds build of RLDS episodes on disk or behind a URL: its features, its shards, and random access to its records.

The three container formats that tfds writes are read: TFRecord (what Open X-Embodiment publishes), array_record and
parquet. All hold the same ``tf.train.Example``.
"""

import dataclasses
import json
import os
import re
from functools import cached_property
from typing import Any, BinaryIO, Literal, Protocol

import numpy as np

from data_pipelines.rlds import files
from data_pipelines.rlds.features import RldsEpisode, parse_features
from data_pipelines.rlds.tfrecord import read_record, record_offsets
from dsvla_jax.errors import DataError

Format = Literal["tfrecord", "array_record", "parquet"]
FORMATS: tuple[Format, ...] = ("tfrecord", "array_record", "parquet")
_TEMPLATE = "{DATASET}-{SPLIT}.{FILEFORMAT}-{SHARD_X_OF_Y}"


@dataclasses.dataclass(frozen=True)
class Shard:
    """One file of a split. records: how many ``dataset_info.json`` promises."""

    path: str
    records: int


class RldsBuild:
    """The build in a folder that holds ``dataset_info.json`` and ``features.json``.

    folder: that folder; or one of a dataset, whose newest version is then taken; a path or a URL.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.folder = find_build(files.as_text(folder))
        info_path = files.join(self.folder, "dataset_info.json")
        info = _read_json(info_path)
        self.name: str = str(info.get("name", "")) or "dataset"
        self.version: str = str(info.get("version", ""))
        self.format: Format = info.get("fileFormat", "tfrecord")
        if self.format not in FORMATS:
            fix = "convert the build to TFRecord"
            raise DataError(info_path, "fileFormat", f"one of {', '.join(FORMATS)}", repr(self.format), fix)
        self._splits = {str(split.get("name")): split for split in info.get("splits", [])}
        self.features_json = _read_json(files.join(self.folder, "features.json"))
        self.features = parse_features(self.features_json, files.join(self.folder, "features.json"))

    @property
    def splits(self) -> tuple[str, ...]:
        """The names of the splits."""
        return tuple(self._splits)

    def shards(self, split: str) -> list[Shard]:
        """The files of a split, in order."""
        where = files.join(self.folder, "dataset_info.json")
        if split not in self._splits:
            raise DataError(where, "splits", split, ", ".join(self._splits) or "none", "choose one of those there are")
        content = self._splits[split]
        lengths = [int(length) for length in content.get("shardLengths", [])]
        template = content.get("filepathTemplate") or _TEMPLATE
        names = [_shard_name(template, self.name, split, self.format, i, len(lengths)) for i in range(len(lengths))]
        return [Shard(files.join(self.folder, name), count) for name, count in zip(names, lengths, strict=True)]

    def open_shard(self, shard: Shard, offsets: np.ndarray | None = None) -> "RecordFile":
        """Random access to a shard's records. offsets: those of a TFRecord shard, where they are known already."""
        match self.format:
            case "tfrecord":
                return TFRecordFile(shard.path, offsets)
            case "array_record":
                return ArrayRecordFile(shard.path)
            case "parquet":
                return ParquetFile(shard.path)

    def parse(self, record: bytes, where: str) -> RldsEpisode:
        """The episode of a record."""
        return RldsEpisode(self.features, record, where)


class RecordFile(Protocol):
    """The records of one file by number. ``read`` verifies the checksums that the format has."""

    def __len__(self) -> int:
        """How many records the file has."""
        ...

    def read(self, number: int) -> bytes:
        """The record of that number. Raises DataError if it is damaged."""
        ...

    def close(self) -> None:
        """Closes the file."""
        ...


class TFRecordFile:
    """A TFRecord file. offsets: (R + 1,), see ``record_offsets``; found by reading all headers where not given."""

    def __init__(self, path: str, offsets: np.ndarray | None = None) -> None:
        self.path = path
        self._file: BinaryIO = files.open_binary(path)
        self._known = offsets

    @cached_property
    def offsets(self) -> np.ndarray:
        """Where the intact records begin and the last one ends."""
        return record_offsets(self._file, files.size_of(self.path), self.path) if self._known is None else self._known

    @property
    def is_whole(self) -> bool:
        """Whether the file ends where its last record ends."""
        return int(self.offsets[-1]) == files.size_of(self.path)

    def __len__(self) -> int:
        return len(self.offsets) - 1

    def read(self, number: int) -> bytes:
        """See `RecordFile`."""
        return read_record(self._file, int(self.offsets[number]), f"{self.path}, record {number}")

    def close(self) -> None:
        """Closes the file."""
        self._file.close()


class ArrayRecordFile:
    """An array_record file, on a local path. Its chunks carry checksums, which its own reader verifies."""

    def __init__(self, path: str) -> None:
        from array_record.python import array_record_module  # pyright: ignore[reportAttributeAccessIssue]

        if files.is_remote(path) or not files.exists(path):
            raise DataError(path, "file", "a local file", "none", "copy the build to a local disk")
        self.path = path
        self._reader = array_record_module.ArrayRecordReader(path, options="readahead_buffer_size:0")
        try:
            if not self._reader.ok():
                # A damaged file has no records, and only closing it tells why.
                self._reader.close()
        except RuntimeError as error:
            got = str(error) or "a truncated one"
            raise DataError(path, "file", "an array_record file", got, "copy the file again") from error

    def __len__(self) -> int:
        return int(self._reader.num_records())

    def read(self, number: int) -> bytes:
        """See `RecordFile`."""
        try:
            (record,) = self._reader.read([number])
        except (RuntimeError, ValueError, IndexError) as error:
            where = f"{self.path}, record {number}"
            raise DataError(where, "record", "readable bytes", str(error), "copy the file again") from error
        return record

    def close(self) -> None:
        """Closes the file."""
        self._reader.close()


class ParquetFile:
    """A parquet file of serialised examples in the column ``data``, as tfds writes it; one row group is in memory."""

    def __init__(self, path: str) -> None:
        import pyarrow
        import pyarrow.parquet as parquet

        self.path = path
        self._error = pyarrow.ArrowException
        self._file = files.open_binary(path)
        try:
            self._parquet = parquet.ParquetFile(self._file, page_checksum_verification=True)
        except (self._error, OSError) as error:
            raise DataError(path, "file", "a parquet file", str(error), "copy the file again") from error
        groups = range(self._parquet.num_row_groups)
        self._first = np.cumsum([0] + [self._parquet.metadata.row_group(group).num_rows for group in groups])
        self._group: tuple[int, pyarrow.ChunkedArray | None] = (-1, None)

    def __len__(self) -> int:
        return int(self._first[-1])

    def read(self, number: int) -> bytes:
        """See `RecordFile`."""
        group = int(np.searchsorted(self._first, number, side="right")) - 1
        if self._group[0] != group:
            try:
                self._group = (group, self._parquet.read_row_group(group, columns=["data"]).column("data"))
            except (self._error, OSError) as error:
                where = f"{self.path}, record {number}"
                raise DataError(where, "record", "readable bytes", str(error), "copy the file again") from error
        column = self._group[1]
        assert column is not None
        return column[number - int(self._first[group])].as_py()

    def close(self) -> None:
        """Closes the file."""
        self._parquet.close()
        self._file.close()


def find_build(folder: str) -> str:
    """The folder itself where it is a build, else its newest version that is one."""
    if files.exists(files.join(folder, "features.json")):
        return folder.rstrip("/")
    versions = [name for name in files.folders_in(folder) if re.fullmatch(r"\d+\.\d+\.\d+", name)]
    for version in sorted(versions, key=lambda name: [int(part) for part in name.split(".")], reverse=True):
        if files.exists(files.join(folder, version, "features.json")):
            return files.join(folder, version)
    fix = "give the folder of a tfds build, as .../bridge_dataset/1.0.0"
    raise DataError(folder, "build", "features.json here, or in a folder named as a version", "neither", fix)


def _shard_name(template: str, dataset: str, split: str, suffix: str, number: int, count: int) -> str:
    values = {
        "DATASET": dataset,
        "SPLIT": split,
        "FILEFORMAT": suffix,
        "SHARD_INDEX": f"{number:05d}",
        "NUM_SHARDS": f"{count:05d}",
        "SHARD_X_OF_Y": f"{number:05d}-of-{count:05d}",
    }
    return re.sub(r"\{(\w+)\}", lambda match: values.get(match[1], match[0]), template)


def _read_json(path: str) -> dict[str, Any]:
    # What tfds wrote: whoever uses a value says what it should have been.
    try:
        value = json.loads(files.read_text(path))
    except ValueError as error:
        raise DataError(path, "file", "JSON", str(error), "copy the build again") from error
    if not isinstance(value, dict):
        raise DataError(path, "file", "a JSON object", type(value).__name__, "copy the build again")
    return value
