"""Mixtures: the index of a dataset, and the range that displacements are binned over."""

import dataclasses
import os
from types import SimpleNamespace
from typing import Any

import fsspec
import numpy as np
import pytest
from tensorflow_datasets.proto import tf_example_pb2

from data_pipelines.oxe.columns import Pose, Read
from data_pipelines.oxe.fixtures.write import known_episodes, write_fixture
from data_pipelines.oxe.index import VERSION, load_index, scan
from data_pipelines.oxe.registry import get_dataset
from data_pipelines.oxe.scale import MixtureScale
from data_pipelines.rlds.build import RldsBuild, TFRecordFile
from data_pipelines.rlds.tfrecord import write_records
from dsvla_jax.encoding.displacement import DisplacementScale
from tests.oxe_mixtures import (
    FIVE,
    config_for,
    make,
    names_of,
    scale_of,
    write_datasets,
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_datasets(tmp_path_factory.mktemp("oxe"))


def test_of_many_frames_evenly_spaced_ones_of_both_arms_make_the_statistics(folder, monkeypatch):
    name = "utokyo_xarm_bimanual_converted_externally_to_rlds"
    monkeypatch.setattr("data_pipelines.oxe.index.KEPT_FRAMES", 30)
    index = scan(RldsBuild(folder / name), get_dataset(name), config_for(folder, (name,)), progress=False)
    ahead = max(1, round(config_for(folder).horizon * get_dataset(name).hz))
    frames = []
    for known in known_episodes(name, 9, 9):
        for step in range(known.num_steps - 1):
            end = min(step + ahead, known.num_steps - 1)
            moved = [
                (arm.position[end] - arm.position[step], (arm.rotation[end] * arm.rotation[step].inv()).as_rotvec())
                for arm in known.arms
            ]
            frames.append(np.reshape(moved, (2, 6)))
    assert len(frames) == index.num_samples == 81
    expected = np.quantile(np.concatenate(frames[::4]), np.linspace(0, 1, 101), axis=0)
    np.testing.assert_allclose(np.asarray(index.quantiles), expected, atol=1e-5)


def test_the_scale_is_that_of_the_known_motion(folder):
    name = names_of(FIVE)[0]
    loader = make(folder, (name,), horizon=0.0001, streams=1)
    moved = []
    for known in known_episodes(name, 9, 9):
        (arm,) = known.arms
        turns = (arm.rotation[1:] * arm.rotation[:-1].inv()).as_rotvec()
        moved.append(np.concatenate([np.diff(arm.position, axis=0), turns], axis=1))
    low, high = np.quantile(np.concatenate(moved), [0.01, 0.99], axis=0)
    np.testing.assert_allclose(scale_of(loader).low, low, atol=3e-4)
    np.testing.assert_allclose(scale_of(loader).high, high, atol=3e-4)


def test_the_scale_is_not_that_of_the_rare_steps_of_what_mostly_stands_still():
    known = SimpleNamespace(metric=True, name="known")
    moves = np.random.default_rng(0).normal(size=(20_000, 6))
    moves[:, 3:][np.random.default_rng(1).random((20_000, 3)) > 0.004] = 0
    rows = np.quantile(moves, np.linspace(0, 1, 101), axis=0)
    opened: Any = [SimpleNamespace(dataset=known, index=SimpleNamespace(quantiles=rows))]
    scale = MixtureScale(opened, np.ones(1)).scale
    for made, at in ((scale.low, 0.01), (scale.high, 0.99)):
        np.testing.assert_allclose(made, np.quantile(moves, at, axis=0), atol=1e-6)


def test_unscaled_data_are_stretched_to_the_metric_range(folder):
    loader = make(folder, ("roboturk", names_of(FIVE)[0]), streams=1)
    alone = make(folder, (names_of(FIVE)[0],), streams=1)
    np.testing.assert_allclose(scale_of(loader).low, scale_of(alone).low, rtol=1e-9)
    assert make(folder, ("roboturk",), streams=1).scale == DisplacementScale((-1.0,) * 6, (1.0,) * 6)


def test_statistics_are_kept_until_the_data_change(tmp_path, monkeypatch):
    write_fixture(tmp_path, "cmu_stretch", episodes=4, steps=6)
    build, dataset = RldsBuild(tmp_path / "cmu_stretch"), get_dataset("cmu_stretch")
    config = config_for(tmp_path, ("cmu_stretch",))
    first = load_index(build, dataset, config, progress=False)
    kept = next((tmp_path / "cmu_stretch" / "0.1.0").glob("dsvla_index_*.json"))
    with monkeypatch.context() as patch:
        patch.setattr("data_pipelines.oxe.index.scan", lambda *_: pytest.fail("scanned again"))
        again = load_index(build, dataset, config, progress=False)
    np.testing.assert_array_equal(again.quantiles, first.quantiles)
    np.testing.assert_array_equal(again.record, first.record)
    other = load_index(build, dataset, dataclasses.replace(config, horizon=0.1), progress=False)
    assert first.quantiles is not None
    assert other.quantiles is not None
    assert not np.array_equal(other.quantiles, first.quantiles)
    assert kept.exists()
    text = kept.read_text()
    kept.write_text(text[:100])
    load_index(build, dataset, config, progress=False)
    assert kept.read_text() == text
    elsewhere = dataclasses.replace(config, cache=str(tmp_path / "cache"))
    load_index(build, dataset, elsewhere, progress=False)
    assert list((tmp_path / "cache").glob("*.json"))


def test_statistics_belong_to_what_the_description_means(tmp_path, monkeypatch, capsys):
    write_fixture(tmp_path, "cmu_stretch", episodes=2, steps=6)
    build, dataset = RldsBuild(tmp_path / "cmu_stretch"), get_dataset("cmu_stretch")
    config = config_for(tmp_path, ("cmu_stretch",))
    first = load_index(build, dataset, config, progress=False)
    arm = dataclasses.replace(dataset.arms[0], pose=Pose(Read("observation/state", 0, 3), "none", scale=0.1))
    smaller = load_index(build, dataclasses.replace(dataset, arms=(arm,)), config, progress=False)
    np.testing.assert_allclose(
        np.asarray(smaller.quantiles)[:, :3], 0.1 * np.asarray(first.quantiles)[:, :3], atol=1e-7
    )
    monkeypatch.setattr("data_pipelines.oxe.index.scan", lambda *_: pytest.fail("scanned again"))
    load_index(build, dataclasses.replace(dataset, notes=("another remark",)), config, progress=False)
    assert not capsys.readouterr().err


def test_an_index_of_another_version_is_reported_and_made_again(tmp_path, monkeypatch, capsys):
    write_fixture(tmp_path, "cmu_stretch", episodes=2, steps=6)
    build, dataset = RldsBuild(tmp_path / "cmu_stretch"), get_dataset("cmu_stretch")
    config = config_for(tmp_path, ("cmu_stretch",))
    load_index(build, dataset, config, progress=False)
    current = next((tmp_path / "cmu_stretch" / "0.1.0").glob("dsvla_index_*.json"))
    old = current.rename(current.with_name("dsvla_index_cmu_stretch_train_0123456789abcdef.json"))
    load_index(build, dataset, config, progress=False)
    assert f"{old}: written by another version of this program" in capsys.readouterr().err
    assert current.read_text() == old.read_text()
    load_index(build, dataset, config, progress=False)
    assert not capsys.readouterr().err


# By dataset: samples, and the largest displacement of the index (metres, radians).
INDEXED = {
    "cmu_stretch": (11, [0.06419, 0.04696, 0.01199, 0.0, 0.0, 0.0]),
    "bridge_orig": (9, [0.03443, 0.00825, 0.00486, 0.06862, 0.04815, 0.19521]),
    "utokyo_xarm_bimanual_converted_externally_to_rlds": (11, [0.02487, 0.04763, 0.01411, 0.14584, 0.15735, 0.09201]),
}


def test_the_version_is_raised_where_code_makes_another_index_of_the_same_data(tmp_path):
    for name, (samples, largest) in INDEXED.items():
        write_fixture(tmp_path, name, episodes=2, steps=6)
        index = scan(RldsBuild(tmp_path / name), get_dataset(name), config_for(tmp_path, (name,)), progress=False)
        assert index.num_samples == samples, f"{name}: raise VERSION in data_pipelines/oxe/index.py, correct INDEXED"
        assert index.quantiles is not None
        np.testing.assert_allclose(index.quantiles[-1], largest, atol=1e-4, err_msg="raise VERSION, correct INDEXED")
    assert VERSION == 4


@pytest.mark.parametrize("remote", [False, True])
def test_statistics_are_made_again_where_only_numbers_changed(tmp_path, remote):
    write_fixture(tmp_path, "cmu_stretch", episodes=2, steps=6, shards=1)
    folder = tmp_path / "cmu_stretch" / "0.1.0"
    config = config_for(tmp_path, ("cmu_stretch",), cache=str(tmp_path / "cache"))

    def quantiles():
        if remote:
            fsspec.filesystem("memory").put(f"{folder}/", "/corrected/0.1.0/", recursive=True)
        build = RldsBuild("memory://corrected" if remote else folder)
        return np.asarray(load_index(build, get_dataset("cmu_stretch"), config, progress=False).quantiles)

    before = quantiles()
    shard = folder / "cmu_stretch-train.tfrecord-00000-of-00001"
    records = TFRecordFile(str(shard))
    examples = [tf_example_pb2.Example.FromString(records.read(number)) for number in range(len(records))]  # pyright: ignore[reportAttributeAccessIssue]
    for example in examples:
        state = example.features.feature["steps/observation/state"].float_list.value
        state[:] = [2 * number for number in state]
    size = shard.stat().st_size
    write_records(shard, [example.SerializeToString() for example in examples])
    assert shard.stat().st_size == size
    np.testing.assert_allclose(quantiles()[:, :3], 2 * before[:, :3], rtol=1e-5)


def test_processes_of_the_same_number_may_write_the_index_at_once(tmp_path, monkeypatch):
    write_fixture(tmp_path, "cmu_stretch", episodes=2, steps=6)
    build, dataset = RldsBuild(tmp_path / "cmu_stretch"), get_dataset("cmu_stretch")
    replace = os.replace

    def meanwhile(source, target):
        monkeypatch.setattr("os.replace", replace)
        load_index(build, dataset, config_for(tmp_path), progress=False)
        replace(source, target)

    monkeypatch.setattr("os.replace", meanwhile)
    assert len(load_index(build, dataset, config_for(tmp_path), progress=False).samples) == 2
    assert len(list((tmp_path / "cmu_stretch" / "0.1.0").glob("dsvla_index_*"))) == 1


def test_no_picture_is_decoded_for_statistics(tmp_path, monkeypatch):
    write_fixture(tmp_path, "cmu_stretch", episodes=2, steps=6)
    monkeypatch.setattr("cv2.imdecode", lambda *_: pytest.fail("decoded"))
    scan(RldsBuild(tmp_path / "cmu_stretch"), get_dataset("cmu_stretch"), config_for(tmp_path), progress=False)
