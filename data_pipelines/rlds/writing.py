"""Writes small RLDS builds as tfds lays them out, without TensorFlow: for fixtures, and to convert one's own data."""

import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
from array_record.python import array_record_module  # pyright: ignore[reportAttributeAccessIssue]
from tensorflow_datasets.core.features import Dataset, FeatureConnector, FeaturesDict, Image

from data_pipelines.rlds.build import Format
from data_pipelines.rlds.features import dtype_of, shape_of
from data_pipelines.rlds.tfrecord import write_records
from dsvla_jax.files import whole_folder


def encode_image(picture: np.ndarray, extension: str = ".jpg", quality: int = 95) -> io.BytesIO:
    """An Image feature's value: the encoded file of (H, W, 3) RGB or (H, W, 1) grey, 8 or 16 bits."""
    picture = np.ascontiguousarray(picture[..., ::-1]) if picture.shape[-1] == 3 else picture
    options = [cv2.IMWRITE_JPEG_QUALITY, quality] if extension == ".jpg" else []
    ok, data = cv2.imencode(extension, picture, options)
    if not ok:
        raise ValueError(f"encode_image: cannot write {picture.dtype} {picture.shape} as {extension}")
    return io.BytesIO(data.tobytes())


def write_build(
    folder: Path,
    name: str,
    features: FeaturesDict,
    splits: Mapping[str, Sequence[Mapping[str, object]]],
    shards: int = 2,
    file_format: Format = "tfrecord",
    version: str = "0.1.0",
) -> Path:
    """Writes ``folder/name/version``, whole or not at all, and returns it.

    splits: episodes by split, each as `features` tells: ``{"steps": [{...}, ...], ...}``, images as `encode_image`.
    shards: files a split; episodes are dealt out in runs.
    """
    build = folder / name / version
    described, stored = [], _stored(features)
    assert isinstance(stored, FeaturesDict)
    with whole_folder(build) as partial:
        for split, episodes in splits.items():
            records = [stored.serialize_example(episode) for episode in episodes]
            runs = [list(map(int, run)) for run in np.array_split(np.arange(len(records)), shards)]
            for number, run in enumerate(runs):
                path = partial / f"{name}-{split}.{file_format}-{number:05d}-of-{shards:05d}"
                _write_shard(path, [records[i] for i in run], file_format)
            described.append(
                {
                    "name": split,
                    "shardLengths": [str(len(run)) for run in runs],
                    "numBytes": str(sum(len(record) for record in records)),
                    "filepathTemplate": "{DATASET}-{SPLIT}.{FILEFORMAT}-{SHARD_X_OF_Y}",
                }
            )
        info = {"name": name, "version": version, "fileFormat": file_format, "moduleName": "", "splits": described}
        (partial / "dataset_info.json").write_text(json.dumps(info, indent=1) + "\n")
        (partial / "features.json").write_text(json.dumps(features.to_json(), indent=1) + "\n")
    return build


def _stored(feature: FeatureConnector) -> FeatureConnector:
    """The features with each float32 Image as the four-channel PNG that it is stored as: tfds has no TF-free writer."""
    if isinstance(feature, Dataset):
        return Dataset(_stored(feature.feature))
    if isinstance(feature, FeaturesDict):
        return FeaturesDict({name: _stored(child) for name, child in feature.items()})
    if isinstance(feature, Image) and dtype_of(feature) == np.float32:
        return Image(shape=(*shape_of(feature)[:2], 4), encoding_format="png")
    return feature


def _write_shard(path: Path, records: list[bytes], file_format: Format) -> None:
    if file_format == "tfrecord":
        write_records(path, records)
    elif file_format == "array_record":
        writer = array_record_module.ArrayRecordWriter(str(path), "group_size:1")
        for record in records:
            writer.write(record)
        writer.close()
    else:
        import pyarrow
        import pyarrow.parquet as parquet

        table = pyarrow.table({"data": pyarrow.array(records, pyarrow.binary())})
        parquet.write_table(table, path, row_group_size=2, write_page_checksum=True)
