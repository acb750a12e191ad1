"""RLDS builds read without TensorFlow: all feature kinds and container formats, and every kind of damage."""

import json
import struct
from typing import Any

import fsspec
import numpy as np
import pytest
from etils import epath
from tensorflow_datasets.core import features as tfds_features

from data_pipelines.rlds.build import FORMATS, Format, RldsBuild
from data_pipelines.rlds.tfrecord import masked_crc
from data_pipelines.rlds.writing import encode_image, write_build
from dsvla_jax.errors import DataError

Tensor = tfds_features.Tensor
STEPS = (3, 0, 2, 4)  # of the four episodes


def feature_spec():
    observation = {
        "image": tfds_features.Image(shape=(12, 16, 3), encoding_format="jpeg"),
        "wrist": tfds_features.Image(shape=(6, 8, 3), encoding_format="png"),
        "depth": tfds_features.Image(shape=(6, 8, 1), dtype=np.uint16, encoding_format="png"),
        "metres": tfds_features.Image(shape=(6, 8, 1), dtype=np.float32, encoding_format="png"),
        "state": Tensor(shape=(2, 3), dtype=np.float32, encoding="zlib"),
        "bytes": Tensor(shape=(4,), dtype=np.int16, encoding="bytes"),
        "natural_language_instruction": Tensor(shape=(), dtype=np.object_),
    }
    steps = {
        "observation": tfds_features.FeaturesDict(observation),
        "action": tfds_features.FeaturesDict({"world_vector": Tensor(shape=(3,), dtype=np.float32)}),
        "reward": tfds_features.Scalar(dtype=np.float64),
        "code": Tensor(shape=(2,), dtype=np.uint8),
        "large": tfds_features.Scalar(dtype=np.int64),
        "is_first": Tensor(shape=(), dtype=np.bool_),
        "language_instruction": tfds_features.Text(),
    }
    return tfds_features.FeaturesDict(
        {
            "steps": tfds_features.Dataset(steps),
            "episode_metadata": tfds_features.FeaturesDict({"file_path": tfds_features.Text()}),
            "success": Tensor(shape=(), dtype=np.bool_),
        }
    )


def values(episode, step):
    """What is written at a step, by feature: the oracle of these tests."""
    rng = np.random.default_rng([episode, step])
    return {
        "image": np.full((12, 16, 3), rng.integers(0, 256, 3), np.uint8),
        "wrist": rng.integers(0, 256, (6, 8, 3), np.uint8),
        "depth": rng.integers(0, 65536, (6, 8, 1), np.uint16),
        "metres": rng.random((6, 8, 1), np.float32),
        "state": rng.random((2, 3), np.float32),
        "bytes": rng.integers(-30000, 30000, 4, np.int16),
        "world_vector": rng.random(3, np.float32),
        "reward": np.float64(np.float32(rng.random())),
        "code": rng.integers(0, 256, 2, np.uint8),
        "large": np.int64(2**40 + step),
        "text": f"pick {episode}-{step} — höher",
    }


def step_example(episode, step, count):
    value = values(episode, step)
    return {
        "observation": {
            "image": encode_image(value["image"]),
            "wrist": encode_image(value["wrist"], ".png"),
            "depth": encode_image(value["depth"], ".png"),
            "metres": encode_image(value["metres"].view(np.uint8)[..., [2, 1, 0, 3]], ".png"),
            "state": value["state"],
            "bytes": value["bytes"],
            "natural_language_instruction": value["text"],
        },
        "action": {"world_vector": value["world_vector"]},
        "reward": value["reward"],
        "code": value["code"],
        "large": value["large"],
        "is_first": step == 0,
        "language_instruction": value["text"],
    }


def write(folder, file_format: Format = "tfrecord", shards=2):
    episodes = [
        {
            "steps": [step_example(number, step, count) for step in range(count)],
            "episode_metadata": {"file_path": f"/raw/{number}"},
            "success": number == 2,
        }
        for number, count in enumerate(STEPS)
    ]
    return write_build(folder, "sample", feature_spec(), {"train": episodes}, shards, file_format)


def episodes_of(build):
    for shard in build.shards("train"):
        records = build.open_shard(shard)
        assert len(records) == shard.records
        for number in range(shard.records):
            yield build.parse(records.read(number), f"{shard.path}, record {number}")
        records.close()


def assert_as_written(build):
    seen = list(episodes_of(build))
    assert [episode.num_steps for episode in seen] == list(STEPS)
    for number, episode in enumerate(seen):
        assert episode.text("episode_metadata/file_path") == [f"/raw/{number}"]
        assert episode.column("success") == (number == 2)
        written = [values(number, step) for step in range(episode.num_steps)]
        for name, path in (("state", "observation/state"), ("bytes", "observation/bytes"), ("reward", "reward"),
                           ("world_vector", "action/world_vector"), ("code", "code"), ("large", "large")):  # fmt: skip
            column = episode.column(f"steps/{path}")
            assert len(column) == len(written)
            for got, value in zip(column, written, strict=True):
                np.testing.assert_array_equal(got, value[name], strict=True)
        texts = [value["text"] for value in written]
        assert episode.text("steps/language_instruction") == texts
        assert episode.text("steps/observation/natural_language_instruction") == texts
        for step, value in enumerate(written):
            for name in ("wrist", "depth", "metres"):
                np.testing.assert_array_equal(
                    episode.image(f"steps/observation/{name}", step), value[name], strict=True
                )
            decoded = episode.image("steps/observation/image", step).astype(int)
            assert np.abs(decoded - value["image"]).max() <= 3, "JPEG of one colour, red first"


@pytest.mark.parametrize("file_format", FORMATS)
def test_every_feature_in_every_container(tmp_path, file_format):
    folder = write(tmp_path, file_format)
    assert_as_written(RldsBuild(folder))
    assert_as_written(RldsBuild(epath.Path(tmp_path) / "sample"))


def test_urls(tmp_path):
    folder = write(tmp_path)
    memory = fsspec.filesystem("memory")
    for file in folder.iterdir():
        memory.pipe_file(f"/bucket/sample/0.1.0/{file.name}", file.read_bytes())
    assert_as_written(RldsBuild("memory://bucket/sample"))


@pytest.mark.parametrize(("url", "message"), [("missing://bucket/sample", "Install missingfs"), ("no://bucket", "no")])
def test_urls_that_cannot_be_opened(url, message):
    fsspec.register_implementation("missing", "missingfs.FileSystem", clobber=True, errtxt="Install missingfs")
    with pytest.raises(DataError, match=f"{url}.*: address: expected a file system that is installed, got .*{message}"):
        RldsBuild(url)


def test_the_newest_version_is_taken(tmp_path):
    old = write(tmp_path)
    (old.parent / "0.10.0").mkdir()
    for file in old.iterdir():
        (old.parent / "0.10.0" / file.name).write_bytes(file.read_bytes())
    assert RldsBuild(old.parent).folder.endswith("0.10.0")
    with pytest.raises(DataError, match=r"nothing: build: expected features\.json here"):
        RldsBuild(tmp_path / "nothing")


def test_the_mask_is_that_of_the_published_example():
    # "123456789" has CRC32C 0xe3069283 (RFC 3720, appendix B.4 uses the same polynomial).
    crc = 0xE3069283
    assert masked_crc(b"123456789") == ((crc >> 15 | crc << 17 & 0xFFFFFFFF) + 0xA282EAD8) & 0xFFFFFFFF


def first_shard(folder):
    return folder / "sample-train.tfrecord-00000-of-00002"


def read_all(folder):
    return [episode.num_steps for episode in episodes_of(RldsBuild(folder))]


def test_a_flipped_bit_is_found(tmp_path):
    folder = write(tmp_path)
    data = bytearray(first_shard(folder).read_bytes())
    data[200] ^= 1
    first_shard(folder).write_bytes(data)
    with pytest.raises(
        DataError, match=r"00000-of-00002, record 0: CRC of the record: expected 0x\w+, got 0x\w+; copy"
    ):
        read_all(folder)
    data[200] ^= 1
    data[0] ^= 1
    first_shard(folder).write_bytes(data)
    with pytest.raises(DataError, match="record 0: CRC of the length"):
        read_all(folder)


def test_a_truncated_shard_keeps_what_is_whole(tmp_path):
    folder = write(tmp_path)
    data = first_shard(folder).read_bytes()
    first_shard(folder).write_bytes(data[:-5])
    build = RldsBuild(folder)
    records: Any = build.open_shard(build.shards("train")[0])
    assert len(records) == 1
    assert not records.is_whole
    assert build.parse(records.read(0), "x").num_steps == 3
    first_shard(folder).unlink()
    with pytest.raises(DataError, match="00000-of-00002: file: expected to be present, got no such file"):
        read_all(folder)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"dtype": "int64"}, "steps/action/world_vector: expected int64_list .*, got float_list"),
        ({"shape": {"dimensions": ["2"]}}, r"steps/action/world_vector: expected float32 \(2,\) a step"),
    ],
)
def test_features_that_do_not_fit_the_records(tmp_path, change, message):
    folder = write(tmp_path)
    features = json.loads((folder / "features.json").read_text())
    step = features["content"]["features"]["steps"]["sequence"]["feature"]["featuresDict"]["features"]
    step["action"]["featuresDict"]["features"]["world_vector"]["tensor"].update(change)
    (folder / "features.json").write_text(json.dumps(features))
    with pytest.raises(DataError, match="00000-of-00002, record 0: " + message):
        next(episodes_of(RldsBuild(folder))).column("steps/action/world_vector")


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("pythonClassName", "my_robot.features.Gripper", "my_robot"),
        ("dtypeOfTomorrow", "float4", "dtypeOfTomorrow"),
    ],
)
def test_features_that_tfds_does_not_know(tmp_path, name, value, message):
    folder = write(tmp_path)
    features = json.loads((folder / "features.json").read_text())
    features["content"]["features"]["success"][name] = value
    (folder / "features.json").write_text(json.dumps(features))
    with pytest.raises(DataError, match=rf"features\.json: features: expected the features of a tfds.*{message}"):
        RldsBuild(folder)


def test_missing_and_unknown_features(tmp_path):
    folder = write(tmp_path)
    build = RldsBuild(folder)
    with pytest.raises(DataError, match=r"steps/nothing: expected a feature of this build.*it has: steps/action/world"):
        next(episodes_of(build)).column("steps/nothing")
    with pytest.raises(DataError, match="steps/language_instruction: expected a numeric tensor"):
        next(episodes_of(build)).column("steps/language_instruction")
    features = json.loads((folder / "features.json").read_text())
    step = features["content"]["features"]["steps"]["sequence"]["feature"]["featuresDict"]["features"]
    step["absent"] = step["is_first"]
    (folder / "features.json").write_text(json.dumps(features))
    with pytest.raises(DataError, match="record 0: steps/absent: expected to be present, got nothing"):
        next(episodes_of(RldsBuild(folder))).column("steps/absent")


@pytest.mark.parametrize("encoding", ["bytes", "zlib"])
def test_steps_of_several_lengths_are_refused_and_empty_ones_read(tmp_path, encoding):
    features = tfds_features.FeaturesDict(
        {"steps": tfds_features.Dataset({"x": Tensor(shape=(None, 2), dtype=np.float32, encoding=encoding)})}
    )
    rows = ([3, 3], [0, 0], [], [1, 3])
    episodes = [{"steps": [{"x": np.ones((count, 2), np.float32)} for count in counts]} for counts in rows]
    build = RldsBuild(write_build(tmp_path, "sample", features, {"train": episodes}))
    read = list(episodes_of(build))
    shapes = [episode.column("steps/x").shape for episode in read[:3]]
    assert shapes == [(2, 3, 2), (2, 0, 2), (0, 0, 2)]
    with pytest.raises(DataError, match=r"record 1: steps/x: expected float32 \(None, 2\) a step, got 2 of \["):
        read[3].column("steps/x")


def test_undecodable_pictures_and_records(tmp_path):
    build = RldsBuild(write(tmp_path))
    with pytest.raises(DataError, match=r"shard 7: record: expected a tf\.train\.Example"):
        build.parse(b"\xff\xff\xff", "shard 7")
    shard = build.shards("train")[0]
    record = build.open_shard(shard).read(0)
    place = record.index(b"\xff\xd8\xff")
    broken = build.parse(record[:place] + b"\x00" * 20 + record[place + 20 :], "shard 7, record 0")
    with pytest.raises(DataError, match="shard 7, record 0, step 0, steps/observation/image: image: expected a JPEG"):
        broken.image("steps/observation/image", 0)


def test_the_kind_of_file_is_checked(tmp_path):
    folder = write(tmp_path)
    info = json.loads((folder / "dataset_info.json").read_text())
    (folder / "dataset_info.json").write_text(json.dumps({**info, "fileFormat": "riegeli"}))
    with pytest.raises(DataError, match="fileFormat: expected one of tfrecord, array_record, parquet, got 'riegeli'"):
        RldsBuild(folder)
    (folder / "dataset_info.json").write_text(json.dumps(info))
    with pytest.raises(DataError, match="splits: expected test, got train; choose"):
        RldsBuild(folder).shards("test")
    parquet = write(tmp_path / "parquet", "parquet")
    (parquet / "sample-train.parquet-00000-of-00002").write_bytes(struct.pack("<4I", 1, 2, 3, 4))
    with pytest.raises(DataError, match="00000-of-00002: file: expected a parquet file"):
        read_all(parquet)
