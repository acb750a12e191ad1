"""Every kind of damage to RLDS builds: an error that names file and record, or, with skip_bad, left out and listed."""

import random
from pathlib import Path

import numpy as np
import pytest
from tensorflow_datasets.core.features import Tensor
from tensorflow_datasets.proto import tf_example_pb2

from data_pipelines.oxe.__main__ import prepare
from data_pipelines.oxe.fixtures.write import known_episodes, write_fixture
from data_pipelines.oxe.index import check_pictures, load_index
from data_pipelines.oxe.loader import OxeLoader
from data_pipelines.oxe.registry import get_dataset
from data_pipelines.oxe.targets import make_targets
from data_pipelines.rlds.build import RldsBuild
from data_pipelines.rlds.tfrecord import write_records
from dsvla_jax.data_config import OxeConfig
from dsvla_jax.encoding.config import EncodingConfig
from dsvla_jax.errors import DataError
from dsvla_jax.suite_vocabulary import suite_tokenizer

EPISODES, STEPS = 6, 6  # in two shards
ENCODING = EncodingConfig(image_size=32, patch_size=16, style="compact", max_text_length=64, use_points=False)
IMAGE = "steps/observation/image"


def config_for(folder, name, **options):
    return OxeConfig(**{"folder": str(folder), "mixture": (name,), "image_size": 32, "streams": 1, **options})


def shard_of(folder, name, number):
    return folder / name / "0.1.0" / f"{name}-train.tfrecord-{number:05d}-of-00002"


def records_of(folder, name):
    build = RldsBuild(folder / name)
    records = build.open_shard(build.shards("train")[0])
    return [records.read(number) for number in range(len(records))]


def in_file(number, change):
    """Damage to the bytes of a shard, or its loss."""

    def damage(folder, name):
        path = shard_of(folder, name, number)
        data = change(bytearray(path.read_bytes()))
        path.unlink()
        if data is not None:
            path.write_bytes(data)

    return damage


def in_record(change):
    """Damage to the content of record 1 of the first shard; its checksums are right."""

    def damage(folder, name):
        records = records_of(folder, name)
        example = tf_example_pb2.Example.FromString(records[1])  # pyright: ignore[reportAttributeAccessIssue]
        change(example.features.feature)
        records[1] = example.SerializeToString()
        write_records(shard_of(folder, name, 0), records)

    return damage


def flipped(place):
    def change(data):
        data[place] ^= 1
        return data

    return change


def set_number(path, place, value):
    def change(features):
        features[path].float_list.value[place] = value

    return change


def matrices(path, size, change):
    """Every step's matrix (size, size) of a feature changed."""

    def changed(features):
        values = features[path].float_list.value
        matrix = np.array(values).reshape(-1, size, size)
        values[:] = np.concatenate([change(one).ravel() for one in matrix]).tolist()

    return changed


def zeros(path):
    def change(features):
        values = features[path].float_list.value
        values[:] = [0.0] * len(values)

    return change


def as_whole_numbers(features):
    numbers = [int(value) for value in features["steps/action"].float_list.value]
    features["steps/action"].int64_list.value[:] = numbers


def without_steps(features):
    for path, feature in features.items():
        if path.startswith("steps/"):
            getattr(feature, feature.WhichOneof("kind")).ClearField("value")


def no_example(folder, name):
    first, _, last = records_of(folder, name)
    write_records(shard_of(folder, name, 0), [first, b"\xff\xff\xff", last])


def set_bytes(path, value):
    def change(features):
        features[path].bytes_list.value[0] = value

    return change


FRACTAL, STRETCH = "fractal20220817_data", "cmu_stretch"
MANISKILL = "maniskill_dataset_converted_externally_to_rlds"
EXTRINSIC, INTRINSIC = (f"steps/observation/main_camera_{name}_cv" for name in ("extrinsic", "intrinsic"))
TILTED = np.array([[0.6, 0, 0.8, 0.3], [0, 1, 0, 0], [-0.8, 0, 0.6, 0], [0, 0, 0, 1]])
SHARD, RECORD = "00001-of-00002", "00000-of-00002, record 1"
# name: (dataset, damage, the place that is named, the message, usable episodes left)
DAMAGE = {
    "flipped bit": (STRETCH, in_file(0, flipped(500)), "00000-of-00002, record 0", "CRC of the record: expected 0x", 5),
    "flipped bit of a length": (STRETCH, in_file(1, flipped(0)), f"{SHARD}, record 0", "CRC of the length", 3),
    "truncated shard": (
        STRETCH,
        in_file(1, lambda data: data[:-9]),
        SHARD,
        "records: expected 3 .*got 2 whole ones",
        5,
    ),
    "missing shard": (STRETCH, in_file(1, lambda _: None), SHARD, "file: expected to be present, got no such file", 3),
    "missing column": (
        STRETCH,
        in_record(lambda features: features.pop("steps/action")),
        RECORD,
        "steps/action: expected to be present, got nothing",
        5,
    ),
    "wrong type": (
        STRETCH,
        in_record(as_whole_numbers),
        RECORD,
        "steps/action: expected float_list.*got int64_list",
        5,
    ),
    "short column": (
        STRETCH,
        in_record(lambda features: features["steps/action"].float_list.value.pop()),
        RECORD,
        r"steps/action: expected float32 \(8,\) a step",
        5,
    ),
    "empty column": (
        STRETCH,
        in_record(lambda features: features["steps/action"].float_list.ClearField("value")),
        RECORD,
        r"steps/action: expected float32 \(8,\) a step",
        5,
    ),
    "nan action": (
        FRACTAL,
        in_record(set_number("steps/action/gripper_closedness_action", 2, np.nan)),
        RECORD,
        "steps/action/gripper_closedness_action: expected finite numbers, got 1 NaN or infinite, the first at step 2",
        5,
    ),
    "infinite pose": (
        FRACTAL,
        in_record(set_number("steps/observation/base_pose_tool_reached", 7, np.inf)),
        RECORD,
        "steps/observation/base_pose_tool_reached: expected finite numbers, got 1 NaN or infinite, the first at step 1",
        5,
    ),
    "stretched rotation": (
        "viola",
        in_record(set_number("steps/observation/ee_states", 16 * 3 + 5, 9.0)),
        RECORD,
        "pose: expected rotations, got another matrix at step 3",
        5,
    ),
    "no steps": (STRETCH, in_record(without_steps), RECORD, "steps: expected more than 0, got 0", 5),
    "missing picture": (
        STRETCH,
        in_record(lambda features: features[IMAGE].bytes_list.value.pop()),
        RECORD,
        f"{IMAGE}: expected 7 values, got 6",
        5,
    ),
    "missing depth": (
        MANISKILL,
        in_record(lambda features: features.pop("steps/observation/depth")),
        RECORD,
        "steps/observation/depth: expected to be present, got nothing",
        5,
    ),
    "nan camera": (
        MANISKILL,
        in_record(set_number(EXTRINSIC, 17, np.nan)),
        RECORD,
        f"{EXTRINSIC}: expected finite numbers, got 1 NaN or infinite, the first at step 1",
        5,
    ),
    "camera of zeros": (
        MANISKILL,
        in_record(zeros(EXTRINSIC)),
        RECORD,
        f"{EXTRINSIC}: expected matrices that can be inverted, got another",
        5,
    ),
    "another matrix than a rotation": (
        MANISKILL,
        in_record(matrices(EXTRINSIC, 4, lambda matrix: matrix * [2, 1, 1, 1])),
        f"{RECORD}, step 0",
        "world_from_camera: expected a rotation, got one off by",
        5,
    ),
    "camera in millimetres": (
        MANISKILL,
        in_record(matrices(EXTRINSIC, 4, lambda matrix: matrix * np.where(matrix == 1.5, 1000, 1))),
        f"{RECORD}, step 0",
        "world_from_camera: expected a place in metres",
        5,
    ),
    "inverse camera": (
        MANISKILL,
        in_record(matrices(EXTRINSIC, 4, lambda matrix: np.linalg.inv(matrix @ TILTED))),
        RECORD,
        "camera: expected the hand in one 256 x 256 picture at least, got none",
        5,
    ),
    "intrinsics of another size": (
        MANISKILL,
        in_record(matrices(INTRINSIC, 3, lambda matrix: np.diag([640 / 256, 480 / 256, 1]) @ matrix)),
        f"{RECORD}, step 0",
        "intrinsics: expected a centre in 256 x 256 pixels, got",
        5,
    ),
    "text that is none": (
        STRETCH,
        in_record(set_bytes("steps/language_instruction", b"\xff\xfe")),
        RECORD,
        "steps/language_instruction: expected UTF-8",
        5,
    ),
    "no example": (
        STRETCH,
        no_example,
        RECORD,
        r"record: expected a tf\.train\.Example",
        5,
    ),
}


@pytest.mark.parametrize("kind", DAMAGE)
def test_damage_is_named_and_left_out_only_on_request(tmp_path, capsys, kind):
    name, damage, where, message, usable = DAMAGE[kind]
    write_fixture(tmp_path, name, EPISODES, STEPS)
    damage(tmp_path, name)
    build, dataset = RldsBuild(tmp_path / name), get_dataset(name)
    with pytest.raises(DataError, match=f"{where}: {message}") as caught:
        load_index(build, dataset, config_for(tmp_path, name), progress=False)
    assert str(tmp_path) in str(caught.value)

    skipping = config_for(tmp_path, name, skip_bad=True)
    loader = OxeLoader(skipping, ENCODING, suite_tokenizer(), batch_size=4, seed=0, num_threads=0, progress=False)
    index = loader.source.datasets[0].index
    assert len(index.samples) == usable
    assert len(loader.left_out) == 1
    assert message.split(":")[0] in str(loader.left_out[0])
    assert capsys.readouterr().err.count("left out (1): ") == 1
    for _ in range(2 * index.num_samples // 4):
        assert np.isfinite(next(loader).pictures.rgb).all()
    assert len(loader.left_out) == 1
    prepare(skipping)
    printed = capsys.readouterr().out
    assert f"left out: {loader.left_out[0][0]}: {loader.left_out[0][1]}" in printed


@pytest.mark.parametrize(
    ("name", "path", "width", "message"),
    [
        (STRETCH, "steps/action", 6, "steps/action: expected at least 7 columns, got 6"),
        (FRACTAL, "steps/observation/base_pose_tool_reached", 6, "pose: expected 7 columns, got 6"),
        (FRACTAL, "steps/action/rotation_delta", 4, "action: expected 6 columns, got 7"),
        ("viola", "steps/observation/ee_states", 15, "pose: expected 16 columns, got 15"),
    ],
)
def test_columns_of_another_version_are_refused(tmp_path, name, path, width, message):
    write_fixture(tmp_path, name, 1, STEPS, shards=1)
    build = RldsBuild(tmp_path / name)
    (record,) = records_of(tmp_path, name)
    example = tf_example_pb2.Example.FromString(record)  # pyright: ignore[reportAttributeAccessIssue]
    example.features.feature[path].float_list.value[:] = np.ones(build.parse(record, "").num_steps * width)
    build.features[path] = Tensor(shape=(width,), dtype=np.float32)
    with pytest.raises(DataError, match=f"shard 7, record 3: {message}; is this the version"):
        get_dataset(name).motion(build.parse(example.SerializeToString(), "shard 7, record 3"))


@pytest.mark.parametrize("file_format", ["array_record", "parquet"])
@pytest.mark.parametrize("damage", ["cut short", "empty", "of another build"])
def test_damaged_shards_of_other_containers_are_named_and_left_out(tmp_path, file_format, damage):
    write_fixture(tmp_path, STRETCH, EPISODES, STEPS, file_format=file_format)
    write_fixture(tmp_path / "other", STRETCH, EPISODES - 2, STEPS, file_format=file_format)
    path, other = (RldsBuild(folder / STRETCH).shards("train")[1].path for folder in (tmp_path, tmp_path / "other"))
    whole = Path(path).read_bytes()
    Path(path).write_bytes({"cut short": whole[:-5], "empty": b""}.get(damage, Path(other).read_bytes()))
    build, dataset = RldsBuild(tmp_path / STRETCH), get_dataset(STRETCH)
    message = (
        "records: expected 3 .*got 2" if damage == "of another build" else f"file: expected an? {file_format} file"
    )
    with pytest.raises(DataError, match=f"{SHARD}: {message}"):
        load_index(build, dataset, config_for(tmp_path, STRETCH), progress=False)
    index = load_index(build, dataset, config_for(tmp_path, STRETCH, skip_bad=True), progress=False)
    assert len(index.samples) == (5 if damage == "of another build" else 3)
    assert len(index.left_out) == 1


@pytest.mark.parametrize("change", ["overwritten", "cut short"])
def test_pictures_that_cannot_be_decoded_stop_or_are_left_out(tmp_path, capsys, change):
    def spoil(features):
        values = features[IMAGE].bytes_list.value
        values[2] = bytes(20) + values[2][20:] if change == "overwritten" else values[2][: len(values[2]) // 2]

    write_fixture(tmp_path, STRETCH, EPISODES, STEPS)
    in_record(spoil)(tmp_path, STRETCH)
    count = sum(episode.num_steps - 1 for episode in known_episodes(STRETCH, EPISODES, STEPS))

    def make(**options):
        config = config_for(tmp_path, STRETCH, **options)
        return OxeLoader(config, ENCODING, suite_tokenizer(), batch_size=1, seed=0, num_threads=0, progress=False)

    with pytest.raises(DataError, match=f"{RECORD}, step 2, {IMAGE}: image: expected a (whole )?JPEG or PNG"):
        for _ in zip(range(count), make(), strict=False):
            pass
    loader = make(skip_bad=True)
    for _ in range(2 * (count - 1)):
        next(loader)
    assert len(loader.left_out) == 1
    assert capsys.readouterr().err.count("left out (1): ") == 1


@pytest.mark.parametrize("name", [STRETCH, FRACTAL, "viola"])
def test_records_changed_at_random_are_read_or_refused(tmp_path, name):
    """Whatever the bytes are, the only error is one that names the record."""
    write_fixture(tmp_path, name, 1, STEPS, shards=2)
    build, dataset, config = RldsBuild(tmp_path / name), get_dataset(name), config_for(tmp_path, name)
    whole = records_of(tmp_path, name)[0]
    rng = random.Random(0)
    refused = []
    for _ in range(300):
        data = bytearray(whole)
        for _ in range(rng.choice([1, 5, 50])):
            data[rng.randrange(len(data))] = rng.randrange(256)
        record = bytes(data[: rng.randrange(len(data))] if rng.random() < 0.3 else data)
        try:
            episode = build.parse(record, "shard 7, record 3")
            make_targets(dataset.motion(episode), dataset, config)
            check_pictures(episode, dataset)
        except DataError as error:
            refused.append(str(error))
    assert len(refused) > 100
    assert all(message.startswith("shard 7, record 3: ") for message in refused)
