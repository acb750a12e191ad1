"""Mixtures: order, resume, targets, statistics, damage, and the calibrated dataset's way into 3D. Known motions."""

import dataclasses
import json
import math
import os
from types import SimpleNamespace
from typing import Any

import fsspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tensorflow_datasets.proto import tf_example_pb2

from data_pipelines.oxe.__main__ import vocabulary as write_words
from data_pipelines.oxe.fixtures import known_episodes, write_fixture
from data_pipelines.oxe.fixtures_converted import DEPTH_COUNTS, camera_from_world
from data_pipelines.oxe.index import load_index, scan
from data_pipelines.oxe.loader import OxeLoader
from data_pipelines.oxe.mixture import MixtureSource, OpenDataset
from data_pipelines.oxe.motion import Motion
from data_pipelines.oxe.order import BlockOrder, deal, schedule
from data_pipelines.oxe.registry import get_dataset
from data_pipelines.oxe.scale import MixtureScale
from data_pipelines.oxe.targets import key_frames, make_targets
from data_pipelines.pictures import crop_intrinsics, crop_resize, random_box, vary_light
from data_pipelines.records import DataError
from data_pipelines.rlds.build import RldsBuild, TFRecordFile
from data_pipelines.rlds.tfrecord import write_records
from data_pipelines.samples import suite_tokenizer
from dsvla_jax.data_config import OxeConfig
from dsvla_jax.encoding.codec import PoseCodec
from dsvla_jax.encoding.displacement import DisplacementScale, displace
from dsvla_jax.encoding.encode import EncodingConfig
from dsvla_jax.encoding.pretrained_tokenizers import load_tokenizer
from dsvla_jax.encoding.prompts import parse_answer
from dsvla_jax.encoding.text import WordTokenizer, vocabulary
from dsvla_jax.errors import UserError

FIVE = ("nyu_rot_dataset_converted_externally_to_rlds=3", "austin_sirius_dataset_converted_externally_to_rlds",
        "cmu_play_fusion=0.5", "utokyo_pr2_opening_fridge_converted_externally_to_rlds=2",
        "cmu_stretch=1.5")  # fmt: skip
MANISKILL = "maniskill_dataset_converted_externally_to_rlds"
ENCODING = EncodingConfig(image_size=32, patch_size=16, style="compact", max_text_length=64, use_points=False)


def names_of(mixture):
    return [entry.partition("=")[0] for entry in mixture]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("oxe")
    for name in (
        *names_of(FIVE),
        MANISKILL,
        "roboturk",
        "berkeley_cable_routing",
        "utokyo_xarm_bimanual_converted_externally_to_rlds",
    ):
        write_fixture(folder, name, episodes=9, steps=9)
    return folder


def config_for(folder, mixture=FIVE, **options):
    return OxeConfig(
        **{"folder": str(folder), "mixture": mixture, "image_size": 32, "streams": 3, "window": 6, **options}
    )


def make(folder, mixture=FIVE, *, batch_size=4, encoding=ENCODING, seed=0, split=(0, 1), threads=2, **options):
    return OxeLoader(
        config_for(folder, mixture, **options),
        encoding,
        suite_tokenizer(),
        batch_size=batch_size,
        seed=seed,
        process_index=split[0],
        process_count=split[1],
        num_threads=threads,
        progress=False,
    )


def test_an_epoch_of_a_stream_is_every_sample_once():
    samples = np.array([3, 1, 7, 2, 5, 4])
    order = BlockOrder(samples, 2, [0])
    total = int(samples.sum())
    epochs = [[order.locate(epoch * total + i)[1:] for i in range(total)] for epoch in range(3)]
    everything = [(episode, place) for episode, count in enumerate(samples) for place in range(count)]
    assert all(sorted(epoch) == everything for epoch in epochs)
    assert epochs[0] != epochs[1] != epochs[2]
    # Never are more than two episodes open, and another order object finds any number by itself.
    for start in range(total - 1):
        blocks = {order.locate(i)[0] for i in (start, start + 1)}
        assert len(blocks) <= 2
    assert [BlockOrder(samples, 2, [0]).locate(i)[1:] for i in (40, 3, 17)] == [
        order.locate(i)[1:] for i in (40, 3, 17)
    ]


def test_episodes_are_dealt_out_once():
    dealt = deal(23, 4, [1])
    assert sorted(np.concatenate(dealt).tolist()) == list(range(23))


@pytest.mark.parametrize("shares", [[1.0], [0.5, 0.5], [0.001, 0.3, 0.699], [0.05] * 20])
def test_turns_follow_the_shares_everywhere(shares):
    shares = np.array(shares)
    dataset, occurrence = schedule(shares, [0])
    for number, share in enumerate(shares):
        turns = dataset == number
        assert turns.mean() == pytest.approx(share, rel=0.01)
        np.testing.assert_array_equal(occurrence[turns], np.arange(turns.sum()))
        passed = np.cumsum(turns) - np.arange(1, len(turns) + 1) * share
        assert np.abs(passed).max() <= 2


def test_an_epoch_of_one_dataset_is_every_frame_once(folder):
    name = names_of(FIVE)[0]
    source = MixtureSource(config_for(folder, (name,), streams=1), seed=3, progress=False)
    expected = sum(episode.num_steps - 1 for episode in known_episodes(name, 9, 9))
    assert source.num_samples == expected
    epochs = [[source[epoch * expected + i].where for i in range(expected)] for epoch in range(2)]
    assert len(set(epochs[0])) == len(set(epochs[1])) == expected
    assert epochs[0] != epochs[1]


def test_an_epoch_of_every_dataset_of_a_mixture_is_every_frame_once(folder):
    """Of each stream of each dataset, whichever process reads which numbers."""
    config = config_for(folder)
    sources = [MixtureSource(config, seed=3, progress=False) for _ in range(3)]
    drawn: dict[tuple[str, int], list[str]] = {}
    for number in range(3000):
        sample = sources[number % 3][number]
        drawn.setdefault((sample.dataset, number % config.streams), []).append(sample.where)
    for name in names_of(FIVE):
        everything: list[str] = []
        for stream in range(config.streams):
            told = drawn[name, stream]
            size = len(set(told))
            epochs = [told[start : start + size] for start in range(0, len(told) - size + 1, size)]
            assert len(epochs) >= 2
            assert all(sorted(epoch) == sorted(set(told)) for epoch in epochs)
            everything += set(told)
        assert len(everything) == len(set(everything))
        assert len(everything) == sum(episode.num_steps - 1 for episode in known_episodes(name, 9, 9))


def test_processes_share_out_the_one_stream(folder):
    source = MixtureSource(config_for(folder), seed=3, progress=False)
    whole = [source[i].where for i in range(90)]
    fresh = MixtureSource(config_for(folder), seed=3, progress=False)
    assert [[fresh[i].where for i in range(p, 90, 3)] for p in range(3)] == [whole[p::3] for p in range(3)]
    records = [{where.partition(", step")[0] for where in whole[p::3]} for p in range(3)]
    assert not (records[0] & records[1]) | (records[1] & records[2]) | (records[0] & records[2])


@pytest.mark.skipif(not os.path.isdir("/proc/self/fd"), reason="needs Linux's /proc")
def test_no_file_stays_open(folder):
    before = len(os.listdir("/proc/self/fd"))
    loader = make(folder, threads=0)
    for _ in range(20):
        next(loader)
    assert len(os.listdir("/proc/self/fd")) <= before


def test_proportions_are_the_weights_times_the_sizes(folder):
    source = MixtureSource(config_for(folder), seed=0, progress=False)
    count = 4000
    drawn = [source[i].dataset for i in range(count)]
    weights = dict(zip(names_of(FIVE), (3, 1, 0.5, 2, 1.5), strict=True))
    sizes = {name: sum(episode.num_steps - 1 for episode in known_episodes(name, 9, 9)) for name in weights}
    total = sum(weights[name] * sizes[name] for name in weights)
    for name in weights:
        assert drawn.count(name) / count == pytest.approx(weights[name] * sizes[name] / total, rel=0.01)


@pytest.mark.parametrize("processes", [1, 3])
def test_a_stopped_run_goes_on_with_the_same_thousand_samples(folder, processes):
    for process in range(processes):
        split, batches = (process, processes), -(-1000 // (20 * processes))
        loader = make(folder, batch_size=20, split=split)
        for _ in range(7 + process):
            next(loader)
        state = json.loads(json.dumps(loader.get_state()))
        resumed = make(folder, batch_size=20, split=split, threads=0)
        resumed.set_state(state)
        for _ in range(batches):
            expected, got = next(loader), next(resumed)
            assert expected.keys() == got.keys()
            for name in expected:
                np.testing.assert_array_equal(got[name], expected[name])


def test_threads_do_not_take_each_others_blocks_away(folder, monkeypatch):
    read, asked = OpenDataset.read, []
    monkeypatch.setattr(OpenDataset, "read", lambda self, episode: asked.append(episode) or read(self, episode))
    loader = make(folder, ("cmu_stretch",), batch_size=48, threads=4, window=3)
    for _ in range(12):
        next(loader)
    # An epoch is 9 episodes of 8 samples, and up to 8 batches are made ahead.
    assert len(asked) <= 9 * math.ceil((12 + 8) * 48 / 72) + 9


def test_a_position_of_other_data_is_refused(folder):
    state = make(folder).get_state()
    with pytest.raises(DataError, match=r"saved position: data: expected .*; put the same data back"):
        make(folder, FIVE[:4]).set_state(state)
    assert set(state["scale"]) == {"low", "high"}
    with pytest.raises(DataError, match=r"saved position: scale: expected .*; put the same data back"):
        make(folder, horizon=0.3).set_state(state)


def scale_of(loader):
    assert loader.scale is not None
    return loader.scale


def truth_of(name, where):
    """The known arms and step of a sample, by the place that it names."""
    record, _, step = where.partition(", step ")
    shard = int(record.rpartition("-of-")[0][-5:])
    number = int(record.rpartition(" ")[2]) + (0 if shard == 0 else 5)
    known = known_episodes(name, 9, 9)[number]
    return known, int(step.partition(",")[0])


def answer_of(batch, row, arms):
    tokens = batch["text_tokens"][row][batch["answer_mask"][row]][:-1]
    return parse_answer(suite_tokenizer().decode([int(token) for token in tokens]), arms, "compact")


@pytest.mark.parametrize("name", ["nyu_rot_dataset_converted_externally_to_rlds", "berkeley_cable_routing",
                                  "utokyo_xarm_bimanual_converted_externally_to_rlds"])  # fmt: skip
def test_relative_answers_lead_to_where_the_hand_went(folder, name):
    loader = make(folder, (name,), streams=1, horizon=0.4, threads=0, batch_size=16)
    places = [loader.source[i] for i in range(16)]
    batch = next(loader)
    codec, ahead = PoseCodec(), max(1, round(0.4 * get_dataset(name).hz))
    scale = scale_of(loader)
    bin_size = (np.array(scale.high) - scale.low) / 200
    for row, place in enumerate(places):
        known, step = truth_of(name, place.where)
        end = min(step + ahead, known.num_steps - 1)
        answer = codec.decode(answer_of(batch, row, len(known.arms)))
        moved = scale.from_pose(answer.pose, codec)
        for i, arm in enumerate(known.arms):
            shift = arm.position[end] - arm.position[step]
            turn = (arm.rotation[end] * arm.rotation[step].inv()).as_rotvec()
            truth = np.clip(np.concatenate([shift, turn]), scale.low, scale.high)
            assert np.all(np.abs(moved[i, :3] - truth[:3]) <= 0.51 * bin_size[:3] + 1e-6)
            # Four rounded components of a quaternion tell an axis to about two bins of its range.
            assert np.all(np.abs(moved[i, 3:] - truth[3:]) <= 2.5 * bin_size[3:] + 1e-6)
            gripper = 0 if name == "berkeley_cable_routing" else arm.open[min(end, known.num_steps - 2)]
            assert answer.gripper_open[i] == gripper


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


def test_absolute_answers_are_poses_and_prompts_have_no_keypoint(folder):
    name = names_of(FIVE)[0]
    loader = make(folder, (name,), streams=1, target="absolute", horizon=0.0, threads=0, batch_size=16)
    places = [loader.source[i] for i in range(16)]
    batch = next(loader)
    assert loader.scale is None
    codec = PoseCodec()
    for row, place in enumerate(places):
        known, step = truth_of(name, place.where)
        (arm,) = known.arms
        changes = np.flatnonzero(np.diff(arm.open)) + 1
        answer = codec.decode(answer_of(batch, row, 1))
        end = min([*changes[changes > step], known.num_steps - 1])
        np.testing.assert_allclose(answer.pose[0, :3], arm.position[end], atol=0.00501)
        assert (Rotation.from_quat(answer.pose[0, 3:]) * arm.rotation[end].inv()).magnitude() < 0.03
        prompt = batch["text_mask"][row] & ~batch["answer_mask"][row]
        text = suite_tokenizer().decode([int(token) for token in batch["text_tokens"][row][prompt]][1:])
        assert text.startswith(known.instruction)
        assert "near" not in text
        state = np.rint(np.append(arm.position[step] * 100, 0)[:3]).astype(int)
        assert " ".join(map(str, state)) in text


@pytest.mark.parametrize("mended", [False, True])
def test_red_and_blue_are_put_right_where_the_copies_are_as_published(tmp_path, mended):
    name = "utaustin_mutex"
    write_fixture(tmp_path, name, episodes=9, steps=9)
    loader = make(tmp_path, (name,), streams=1, threads=0, crop=1.0, colour_variation=0.0, colours_mended=mended)
    places = [loader.source[i] for i in range(4)]
    for rgb, place in zip(next(loader)["rgb"], places, strict=True):
        known, step = truth_of(name, place.where)
        red, green, blue = known.colour(step)
        expected = (blue, green, red) if mended else (red, green, blue)
        assert np.abs(rgb.astype(int) - expected).max() <= 3


def test_key_frames_are_gripper_changes_rests_and_the_end():
    positions = np.cumsum([0, 1, 1, 0, 0, 0, 1, 1, 1, 1, 1, 1], dtype=float) * 0.05
    pose = np.zeros((12, 1, 7), np.float32)
    pose[:, 0, 0], pose[:, 0, 6] = positions, 1
    command = np.ones((12, 1), np.float32)
    command[8:] = 0
    motion = Motion("", pose, command, None, command)
    # The hand rests from step 2 on, the gripper closes at step 8, the last step is 11.
    assert key_frames(motion) == [2, 8, 11]
    targets = make_targets(motion, get_dataset("cmu_stretch"), OxeConfig(target="absolute", horizon=0.0))
    assert targets.target_pose is not None
    np.testing.assert_allclose(targets.target_pose[:, 0, 0], positions[[2, 2, 8, 8, 8, 8, 8, 8, 11, 11, 11]])


def test_commands_compose_where_no_pose_is_told(folder):
    # The tool turns by a quarter about z between two steps forward, in its own frame.
    action = np.zeros((4, 1, 6), np.float32)
    action[:2, 0, 0], action[0, 0, 5] = 0.1, np.pi / 2
    command = np.ones((4, 1), np.float32)
    motion = Motion("", None, command, action, command)
    config = OxeConfig(horizon=0.2)
    tool = make_targets(motion, get_dataset("imperialcollege_sawyer_wrist_cam"), config)
    assert tool.displacement is not None
    np.testing.assert_allclose(tool.displacement[0, 0], [0.1, 0.1, 0, 0, 0, np.pi / 2], atol=1e-6)
    base = make_targets(motion, dataclasses.replace(get_dataset("cmu_play_fusion"), hz=10), config)
    assert base.displacement is not None
    np.testing.assert_allclose(base.displacement[0, 0], [0.2, 0, 0, 0, 0, np.pi / 2], atol=1e-6)


def test_displacements_survive_the_box_and_lead_there():
    rng = np.random.default_rng(0)
    scale = DisplacementScale((-0.1, -0.2, -0.05, -0.5, -1, -0.2), (0.1, 0.1, 0.05, 0.5, 1.5, -0.2))
    moved = rng.uniform(scale.low, scale.high, (200, 6))
    codec = PoseCodec()
    pose = scale.to_pose(moved, codec)
    assert np.all(pose[:, :3] >= codec.low) and np.all(pose[:, :3] <= codec.high)  # noqa: PT018
    np.testing.assert_allclose(scale.from_pose(pose, codec), moved, atol=1e-5)
    start = np.concatenate([rng.normal(size=(200, 3)), Rotation.random(200, rng=rng).as_quat()], axis=1)
    end = displace(start, moved)
    np.testing.assert_allclose(end[:, :3] - start[:, :3], moved[:, :3], atol=1e-6)
    turned = Rotation.from_quat(end[:, 3:]) * Rotation.from_quat(start[:, 3:]).inv()
    np.testing.assert_allclose((turned * Rotation.from_rotvec(moved[:, 3:]).inv()).magnitude(), 0, atol=1e-6)
    # A component without a range says nothing and is read as its value.
    assert np.all(scale.from_pose(pose, codec)[:, 5] == np.float32(-0.2))


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


def test_calibrated_depth_feeds_the_3d_path(folder):
    encoding = dataclasses.replace(ENCODING, use_points=True)
    loader = make(folder, (MANISKILL,), encoding=encoding, image_size=64, crop=0.6, streams=1, threads=0)
    batch = next(loader)
    assert batch["depth"].shape == (4, 64, 64)
    np.testing.assert_allclose(batch["depth"], DEPTH_COUNTS / 1024)
    world_from_camera = np.linalg.inv(camera_from_world())
    for intrinsics, pose in zip(batch["intrinsics"], batch["world_from_camera"], strict=True):
        np.testing.assert_allclose(pose, world_from_camera, atol=1e-6)
        # The camera looks straight down from 1.5 m onto z = 0, so each pixel's point has z = 0, and a crop that moves
        # by one pixel moves the point by a pixel's size.
        pixel = np.linalg.inv(intrinsics) @ [10, 20, 1]
        point = pose @ np.append(1.5 * pixel, 1)
        assert abs(point[2]) < 1e-5
    with pytest.raises(UserError, match=r"encoding.use_points: cmu_stretch have no calibrated depth"):
        make(folder, (MANISKILL, "cmu_stretch"), encoding=encoding)


def test_a_crop_takes_the_camera_along():
    rng = np.random.default_rng(0)
    intrinsics = np.array([[200, 0, 63.5], [0, 180, 47.5], [0, 0, 1]], np.float32)
    # Where a world point falls in the picture, and where the same content is after cropping.
    rows, columns = np.meshgrid(np.arange(96), np.arange(128), indexing="ij")
    for _ in range(20):
        box = random_box(rng, 96, 128, 0.5)
        moved = crop_intrinsics(intrinsics, box, 64)
        shown_rows, shown_columns = (crop_resize(x.astype(np.float32), box, 64) for x in (rows, columns))
        u, v = rng.integers(8, 56, 2)
        ray = np.linalg.inv(moved.astype(np.float64)) @ [u, v, 1]
        before = intrinsics @ ray
        assert before[0] == pytest.approx(shown_columns[v, u], abs=0.1)
        assert before[1] == pytest.approx(shown_rows[v, u], abs=0.1)


def test_exchanged_colours_are_put_right(tmp_path):
    name = "utaustin_mutex"
    write_fixture(tmp_path, name, episodes=9, steps=9)
    loader = make(tmp_path, (name,), streams=1, threads=0, crop=1.0, colour_variation=0.0)
    for row, picture in enumerate(next(loader)["rgb"]):
        known, step = truth_of(name, loader.source[row].where)
        np.testing.assert_allclose(picture.mean((0, 1)), known.colour(step), atol=3)


def test_light_varies_colours_and_nothing_else():
    picture = np.random.default_rng(0).integers(0, 256, (8, 8, 3), np.uint8)
    same = vary_light(picture, np.random.default_rng(1), 0.0)
    np.testing.assert_allclose(same.astype(int), picture, atol=1)
    varied = vary_light(picture, np.random.default_rng(1), 0.3)
    assert varied.shape == picture.shape
    assert np.abs(varied.astype(int) - picture).mean() > 2
    np.testing.assert_array_equal(varied, vary_light(picture, np.random.default_rng(1), 0.3))


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
    examples = [tf_example_pb2.Example.FromString(records.read(number)) for number in range(len(records))]
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


def test_unknown_words_need_a_vocabulary(folder, tmp_path, capsys):
    config = config_for(folder)
    few = WordTokenizer(vocabulary(["turn on the light", "close the fridge"]))

    def make_with(tokenizer):
        return OxeLoader(config, ENCODING, tokenizer, batch_size=4, seed=0, num_threads=0, progress=False)

    with pytest.raises(UserError, match=r"no token for 'ball', 'bin', 'lift', 'put', 'rubbish'; write one with `"):
        make_with(few)
    write_words(tmp_path / "words", config)
    tokenizer = load_tokenizer(tmp_path / "words")
    assert f"--model.language.vocab-size {tokenizer.vocab_size}" in capsys.readouterr().out
    batch = next(make_with(tokenizer))
    assert not np.any(batch["text_tokens"] == few.unk_id)


def test_datasets_that_cannot_give_the_targets(folder):
    with pytest.raises(UserError, match=r"roboturk: it tells no poses of the hand.*Set target to relative"):
        make(folder, ("roboturk", "cmu_stretch"), target="absolute")
    with pytest.raises(UserError, match=r"relative targets: aloha_\w+: it tells joints, not the hand\. Choose others"):
        make(folder, ("aloha_static_dataset", "cmu_stretch"))
    loader = make(folder, ("roboturk", "cmu_stretch"), target="absolute", unsupported="leave_out")
    assert [item.dataset.name for item in loader.source.datasets] == ["cmu_stretch"]
    with pytest.raises(UserError, match="toto: no such dataset; copy it there from gs://gresearch/robotics/toto"):
        make(folder, ("toto",))
    with pytest.raises(UserError, match="9 usable episodes cannot be dealt to 16 streams; lower `streams`"):
        make(folder, ("cmu_stretch",), streams=16)
