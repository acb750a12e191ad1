"""Episodes on disk, the loader and the generation of demonstrations, over small pictures with known contents."""

import dataclasses
import itertools
import json
import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from data_pipelines import augment
from data_pipelines.demos import Options, ScriptedExpert, Settings, generate_demonstrations, main
from data_pipelines.episodes import EpisodeReader, write_episodes
from data_pipelines.loader import make_loader
from data_pipelines.records import (
    decode_depth,
    decode_frame,
    decode_rgb,
    encode_depth,
    encode_rgb,
    mark_missing,
    pack_episode,
    unpack_episode,
)
from dsvla_jax.encoding.keypoints import replay_latch
from dsvla_jax.errors import DataError, UserError
from dsvla_jax.geometry.cameras import project
from dsvla_jax.sim.seeds import episode_keys
from dsvla_jax.types import Action, Camera
from tests.random_data import random_episode


@pytest.fixture
def folder(tmp_path):
    write_episodes(tmp_path, [random_episode(seed, frames=1 + seed % 4) for seed in range(7)], per_shard=3)
    return tmp_path


def assert_equal_episodes(one, other):
    for field in dataclasses.fields(one):
        np.testing.assert_array_equal(getattr(one, field.name), getattr(other, field.name), err_msg=field.name)


def test_pictures_survive_encoding():
    rng = np.random.default_rng(0)
    rgb = rng.integers(0, 256, (9, 7, 3), np.uint8)
    depth = rng.uniform(0, 6.5, (9, 7))
    depth[0, 0] = 0
    np.testing.assert_array_equal(decode_rgb(encode_rgb(rgb)), rgb)
    np.testing.assert_allclose(decode_depth(encode_depth(depth)), depth, atol=0.51e-4)
    assert decode_depth(encode_depth(depth))[0, 0] == 0


@pytest.mark.parametrize("bad", [np.nan, np.inf, -0.1, 7.0])
def test_impossible_depth_is_refused(bad):
    depth = np.ones((4, 4))
    depth[1, 2] = bad
    with pytest.raises(DataError, match=r"depth: expected .*; .*write 0"):
        encode_depth(depth)


def test_record_roundtrip_and_determinism():
    episode = random_episode(3, arms=2)
    assert_equal_episodes(unpack_episode(pack_episode(episode)), episode)
    assert pack_episode(random_episode(3, arms=2)) == pack_episode(episode)


def test_non_finite_numbers_are_refused():
    episode = random_episode(0)
    pose = episode.pose.copy()
    pose[0, 0, 0] = np.nan
    with pytest.raises(DataError, match="shard-7: pose: expected finite"):
        unpack_episode(pack_episode(dataclasses.replace(episode, pose=pose)), "shard-7")


def test_pickle_is_not_read():
    with pytest.raises(DataError):
        unpack_episode(pickle.dumps({"version": 1}))


def test_reader_numbers_all_episodes_and_frames(folder):
    reader = EpisodeReader(folder, verify="sha256")
    assert len(reader) == 7
    assert reader.num_frames == sum(1 + seed % 4 for seed in range(7))
    for seed in range(7):
        assert_equal_episodes(reader.episode(seed), random_episode(seed, frames=1 + seed % 4))
    seen = [reader.locate(number) for number in range(reader.num_frames)]
    assert seen == [(seed, place) for seed in range(7) for place in range(1 + seed % 4)]
    frame = reader.frame(seen.index((5, 1)))
    assert frame.instruction == "do lamp_on number 5"
    np.testing.assert_array_equal(frame.robot.pose, random_episode(5, frames=2).pose[1])
    assert len(EpisodeReader(folder, episodes=4)) == 4
    with pytest.raises(DataError, match="episodes of lamp_on: expected at least 8, got 7; run"):
        EpisodeReader(folder, episodes=8)
    np.testing.assert_array_equal(
        pickle.loads(pickle.dumps(reader)).frame(2).pictures.rgb, reader.frame(2).pictures.rgb
    )


def test_writing_twice_gives_the_same_bytes(folder, tmp_path_factory):
    again = tmp_path_factory.mktemp("again")
    write_episodes(again, [random_episode(seed, frames=1 + seed % 4) for seed in range(7)], per_shard=3)
    names = sorted(path.name for path in folder.iterdir())
    assert names == sorted(path.name for path in again.iterdir())
    for name in names:
        assert (folder / name).read_bytes() == (again / name).read_bytes()


def test_damaged_folders_are_refused(folder):
    shard = folder / "lamp_on-00001.array_record"
    data = shard.read_bytes()
    shard.write_bytes(data[: len(data) // 2])
    with pytest.raises(DataError, match=r"lamp_on-00001.array_record: size: expected \d+ bytes, got .*truncated"):
        EpisodeReader(folder)
    place = data.index(b"PNG")
    shard.write_bytes(data[:place] + b"GNP" + data[place + 3 :])
    with pytest.raises(DataError, match="sha256"):
        EpisodeReader(folder, verify="sha256")
    shard.unlink()
    with pytest.raises(DataError, match="no such file; delete it and run"):
        EpisodeReader(folder)
    shard.write_bytes(data)
    with pytest.raises(DataError, match="tasks: expected some of"):
        EpisodeReader(folder, tasks=["lamp_off"])
    index = json.loads((folder / "index.json").read_text())
    (folder / "index.json").write_text(json.dumps({**index, "version": 99}))
    with pytest.raises(DataError, match="version: expected 1, got 99"):
        EpisodeReader(folder)
    (folder / "index.json").unlink()
    with pytest.raises(DataError, match=r"python -m data_pipelines\.demos"):
        EpisodeReader(folder)


def place(frame, rng):
    """A sample that says where in the demonstrations it is from."""
    return {"episode": np.array(frame.episode), "frame": np.array(frame.frame)}


def identities(batches):
    return [(int(e), int(f)) for batch in batches for e, f in zip(batch["episode"], batch["frame"], strict=True)]


def test_an_epoch_is_every_frame_once_in_a_new_order(folder):
    reader = EpisodeReader(folder)
    count = reader.num_frames
    stream = identities(
        batch for batch, _ in zip(make_loader(reader, place, batch_size=1, seed=3), range(2 * count), strict=False)
    )
    everything = [reader.locate(number) for number in range(count)]
    first, second = stream[:count], stream[count:]
    assert sorted(first) == sorted(second) == everything
    assert first != everything
    assert first != second
    other = identities(
        batch for batch, _ in zip(make_loader(reader, place, batch_size=1, seed=4), range(count), strict=False)
    )
    assert other != first
    assert identities(make_loader(reader, place, batch_size=1, seed=3, shuffle=False, num_epochs=1)) == everything


def test_batches_have_stacked_fields(folder):
    def sample(frame, rng):
        return frame.pictures, frame.robot, frame.target, frame.keypoint, np.array(frame.instruction)

    batch = next(make_loader(EpisodeReader(folder), sample, batch_size=4, seed=0))
    pictures, robot, target, keypoint = jax.tree.map(lambda value: (value.shape, value.dtype), batch[:4])
    assert pictures.rgb == ((4, 1, 8, 8, 3), np.uint8)
    assert pictures.depth == ((4, 1, 8, 8), np.float32)
    assert pictures.camera.world_from_camera == ((4, 1, 4, 4), np.float32)
    assert robot.pose == target.pose == ((4, 1, 7), np.float32)
    assert keypoint == ((4, 1, 3), np.float32)
    assert [str(text)[:10] for text in batch[4]] == ["do lamp_on"] * 4


def test_resumed_iterator_continues_exactly(folder):
    def sample(frame, rng):
        frame = augment.perturb_keypoint(frame, rng, 0.03, 0.5)
        return {"rgb": frame.pictures.rgb, "keypoint": frame.keypoint, **place(frame, rng)}

    iterator = make_loader(EpisodeReader(folder), sample, batch_size=4, seed=1)
    for _ in range(6):
        next(iterator)
    state = json.loads(json.dumps(iterator.get_state()))
    expected = [next(iterator) for _ in range(5)]
    resumed = make_loader(EpisodeReader(folder), sample, batch_size=4, seed=1)
    resumed.set_state(state)
    for batch in expected:
        jax.tree.map(np.testing.assert_array_equal, next(resumed), batch)


def position_after(folder, batches=3, **choice):
    iterator = make_loader(EpisodeReader(folder, **choice), place, batch_size=4, seed=1)
    for _ in range(batches):
        next(iterator)
    return json.loads(json.dumps(iterator.get_state()))


def test_a_position_is_refused_in_other_demonstrations(folder, tmp_path_factory):
    """A folder that grew, or was written again, would go on with other samples without a word."""
    state = position_after(folder)
    episodes = [random_episode(seed, frames=1 + seed % 4) for seed in range(7)]
    grown, other = tmp_path_factory.mktemp("grown"), tmp_path_factory.mktemp("other")
    write_episodes(grown, [*episodes, random_episode(7, frames=2)], per_shard=3)
    write_episodes(other, [*episodes[:6], random_episode(8, frames=3)], per_shard=3)
    with pytest.raises(
        DataError,
        match=r"grown.*: expected lamp_on 7 episodes \(16 frames\) as at the saved position, got lamp_on 8 episodes"
        r" \(18 frames\); .* start a new run with these",
    ):
        make_loader(EpisodeReader(grown), place, batch_size=4, seed=1).set_state(state)
    with pytest.raises(DataError, match=r"other.*: expected those of the saved position, got as many others"):
        make_loader(EpisodeReader(other), place, batch_size=4, seed=1).set_state(state)


def test_a_position_outlives_growth_by_episodes_that_are_not_used(tmp_path):
    """One folder may serve runs that want more and fewer demonstrations of a task."""
    generate_demonstrations(tmp_path, ["lamp_on"], 5, demonstrator=FakeExpert(), batch=4, progress=False)
    state = position_after(tmp_path, episodes=5)
    expected = identities([next(resumed(tmp_path, state, episodes=5))])
    generate_demonstrations(tmp_path, ["lamp_on"], 9, demonstrator=FakeExpert(), batch=4, progress=False)
    assert identities([next(resumed(tmp_path, state, episodes=5))]) == expected


def resumed(folder, state, **choice):
    iterator = make_loader(EpisodeReader(folder, **choice), place, batch_size=4, seed=1)
    iterator.set_state(state)
    return iterator


def test_positions_of_earlier_versions_are_still_taken(folder):
    iterator = make_loader(EpisodeReader(folder), place, batch_size=4, seed=1)
    *_, batch = (next(iterator) for _ in range(4))
    # What was saved before the demonstrations were noted beside the number, and before an index held digests.
    index = json.loads((folder / "index.json").read_text())
    for entry in index["shards"]:
        del entry["digests"]
    (folder / "index.json").write_text(json.dumps(index))
    assert identities([next(resumed(folder, {"next_index": 3}))]) == identities([batch])
    state = position_after(folder)
    assert identities([next(resumed(folder, state))]) == identities([batch])


def test_processes_share_the_samples_out(folder):
    reader = EpisodeReader(folder)

    def stream(count, **split):
        return identities(
            batch
            for batch, _ in zip(make_loader(reader, place, batch_size=1, seed=5, **split), range(count), strict=False)
        )

    whole = stream(20)
    assert [
        x for pair in zip(*(stream(10, process_index=i, process_count=2) for i in (0, 1)), strict=True) for x in pair
    ] == whole


def test_processes_cut_the_same_batches_and_take_over_from_each_other(folder):
    """A batch of 4 is the same one whether 1, 2 or 4 processes share it, and a position is good for any of them."""

    def sample(frame, rng):
        return {"keypoint": augment.perturb_keypoint(frame, rng, 0.03, 0.5).keypoint, "frame": np.array(frame.frame)}

    def loaders(count):
        split = [{"process_index": i, "process_count": count} for i in range(count)]
        return [make_loader(EpisodeReader(folder), sample, batch_size=4 // count, seed=2, **part) for part in split]

    def whole(parts):
        return jax.tree.map(lambda *rows: np.concatenate(rows), *[next(part) for part in parts])

    (alone,) = loaders(1)
    expected = [whole([alone]) for _ in range(7)]
    position = None
    for count, batches in ((2, expected[:3]), (4, expected[3:6]), (1, expected[6:])):
        parts = loaders(count)
        for part in parts:
            if position is not None:
                part.set_state(position)
        for batch in batches:
            jax.tree.map(np.testing.assert_array_equal, whole(parts), batch)
        states = [part.get_state() for part in parts]
        assert states == [states[0]] * count
        position = json.loads(json.dumps(states[0]))


def test_a_sample_of_equal_shapes_mixes_tasks_of_one_and_two_arms(tmp_path):
    write_episodes(tmp_path, [random_episode(0), random_episode(1, task="push_box", arms=2)])
    reader = EpisodeReader(tmp_path)

    def sample(frame, rng):
        return {"rgb": frame.pictures.rgb, "task": np.array(frame.task_index)}

    batch = next(make_loader(reader, sample, batch_size=6, seed=0))
    assert sorted(batch["task"]) == [0, 0, 0, 1, 1, 1]
    assert EpisodeReader(tmp_path, tasks=["push_box"]).num_arms == {"push_box": 2}


def test_episode_keys_depend_on_the_number_alone():
    data = jax.random.key_data
    keys = data(episode_keys(0, "train", "lamp_on", 0, 10))
    np.testing.assert_array_equal(data(episode_keys(0, "train", "lamp_on", 4, 3)), keys[4:7])
    streams = itertools.product((0, 1), ("train", "eval"), ("lamp_on", "close_fridge"))
    every = np.concatenate([data(episode_keys(*stream, 0, 300)) for stream in streams])
    assert len({tuple(key) for key in every.tolist()}) == len(every)
    with pytest.raises(ValueError, match="split: expected one of"):
        episode_keys(0, "test", "lamp_on", 0, 1)


class FakeExpert:
    """Every third attempt fails; stops the run at a given attempt."""

    def __init__(self, interrupt_at=None):
        self.interrupt_at = interrupt_at
        self.starts = []

    def __call__(self, task, settings):
        def demonstrate(start, count):
            if start == self.interrupt_at:
                raise KeyboardInterrupt
            self.starts.append((task, start))
            return [None if i % 3 == 0 else random_episode(i, task=task) for i in range(start, start + count)]

        return demonstrate


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_generation_replaces_failures_and_is_deterministic(tmp_path):
    for folder in (tmp_path / "a", tmp_path / "b"):
        generate_demonstrations(folder, ["lamp_on"], 10, demonstrator=FakeExpert(), batch=4, progress=False)
    assert contents(tmp_path / "a") == contents(tmp_path / "b")
    reader = EpisodeReader(tmp_path / "a")
    assert [reader.episode(i).seed for i in range(10)] == [1, 2, 4, 5, 7, 8, 10, 11, 13, 14]
    assert len(reader) == 10


def fake_expert(task, settings):
    return FakeExpert()(task, settings)


def test_processes_make_the_same_files(tmp_path):
    tasks = ["lamp_on", "close_fridge"]
    for folder, workers in ((tmp_path / "one", 1), (tmp_path / "two", 2)):
        generate_demonstrations(folder, tasks, 8, demonstrator=fake_expert, workers=workers, batch=4, progress=False)
    assert contents(tmp_path / "one") == contents(tmp_path / "two")


def test_interrupted_generation_continues_where_it_stopped(tmp_path):
    tasks = ["lamp_on", "close_fridge"]
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    generate_demonstrations(whole, tasks, 8, demonstrator=FakeExpert(), batch=4, progress=False)
    with pytest.raises(KeyboardInterrupt):
        generate_demonstrations(parts, tasks, 8, demonstrator=FakeExpert(interrupt_at=8), batch=4, progress=False)
    # A file that was being written when the program stopped.
    (parts / "lamp_on-00002.array_record").write_bytes(b"half")
    rest = FakeExpert()
    generate_demonstrations(parts, tasks, 8, demonstrator=rest, batch=4, progress=False)
    assert rest.starts == [("lamp_on", 8), ("close_fridge", 0), ("close_fridge", 4), ("close_fridge", 8)]
    assert contents(parts) == contents(whole)
    rest = FakeExpert()
    generate_demonstrations(parts, tasks, 8, demonstrator=rest, batch=4, progress=False)
    assert rest.starts == []


def test_more_episodes_and_missing_shards_are_made_but_damaged_ones_are_refused(tmp_path):
    small, large = tmp_path / "small", tmp_path / "large"
    generate_demonstrations(large, ["lamp_on"], 9, demonstrator=FakeExpert(), batch=4, progress=False)
    generate_demonstrations(small, ["lamp_on"], 4, demonstrator=FakeExpert(), batch=4, progress=False)
    more = FakeExpert()
    generate_demonstrations(small, ["lamp_on"], 9, demonstrator=more, batch=4, progress=False)
    assert contents(small) == contents(large)
    assert more.starts == [("lamp_on", 4), ("lamp_on", 8), ("lamp_on", 12)]
    shard = small / "lamp_on-00001.array_record"
    shard.write_bytes(shard.read_bytes()[:1000])
    again = FakeExpert()
    with pytest.raises(DataError, match=r"lamp_on-00001.array_record: size: .*delete it and run the program"):
        generate_demonstrations(small, ["lamp_on"], 9, demonstrator=again, batch=4, progress=False)
    assert shard.stat().st_size == 1000
    shard.unlink()
    generate_demonstrations(small, ["lamp_on"], 9, demonstrator=again, batch=4, progress=False)
    assert again.starts == [("lamp_on", 4)]
    assert contents(small) == contents(large)


def test_generation_refuses_other_settings_and_a_broken_expert(tmp_path):
    generate_demonstrations(tmp_path, ["lamp_on"], 2, demonstrator=FakeExpert(), batch=4, progress=False)
    with pytest.raises(DataError, match=r"index.json: settings.seed: expected 1 as asked for, got 0; choose"):
        generate_demonstrations(tmp_path, ["lamp_on"], 2, demonstrator=FakeExpert(), batch=4, seed=1, progress=False)

    def hopeless(task, settings):
        return lambda start, count: [None] * count

    with pytest.raises(ValueError, match=r"lamp_on: expected 3 successes .* got 0 in 40 attempts"):
        generate_demonstrations(tmp_path / "new", ["lamp_on"], 3, demonstrator=hopeless, batch=4, progress=False)


def test_missing_depth_becomes_zero():
    depth = np.array([[1.5, np.inf], [np.nan, 100.0]])
    np.testing.assert_array_equal(mark_missing(depth), [[1.5, 0], [0, 0]])


def test_latch_is_replayed_in_order_and_never_goes_back():
    keypoints = np.array([[[0, 0, 0], [1, 0, 0]]], np.float32)
    way = np.array([[0.5, 0, 0], [1, 0, 0], [0.04, 0, 0], [0.5, 0, 0], [1, 0, 0], [0, 0, 0]], np.float32)[:, None]
    active = replay_latch(jnp.asarray(way), jnp.asarray(keypoints))
    # Passing the second keypoint before the first does not count.
    np.testing.assert_array_equal(active[:, 0, 0], [0, 0, 1, 1, 1, 1])


def test_recorded_expert_succeeds_again_from_its_seed(tmp_path):
    # In pictures as small, objects are not seen.
    options = {"image_size": 24, "batch": 2, "perturb_probability": 1.0, "keypoints": "oracle"}
    expert = ScriptedExpert("lamp_on", Settings(**options))
    for folder in (tmp_path / "a", tmp_path / "b"):
        generate_demonstrations(folder, ["lamp_on"], 2, demonstrator=lambda *_: expert, progress=False, **options)
    assert contents(tmp_path / "a") == contents(tmp_path / "b")
    reader = EpisodeReader(tmp_path / "a")
    episode = reader.episode(1)

    environment = expert.environment
    assert [reader.episode(i).seed for i in range(2)] == [0, 1]
    state = environment.reset(episode_keys(0, "train", "lamp_on", 0, 2))
    first = environment.observe(state)
    for i in range(2):
        frame = decode_frame(reader.episode(i), 0)
        np.testing.assert_array_equal(frame.pictures.rgb, first.pictures.rgb[i])
        # The format keeps tenths of a millimetre.
        np.testing.assert_allclose(frame.pictures.depth, mark_missing(np.asarray(first.pictures.depth[i])), atol=1e-4)
    for m in range(episode.num_frames):
        both = [reader.episode(i) for i in range(2)]
        pose = jnp.stack([x.target_pose[m] for x in both])
        state = environment.step(state, Action(pose, jnp.stack([x.target_gripper[m] for x in both])))
    assert np.all(environment.success(state))

    # The arm was led off the expert's way, by no more than asked for, and is still told the expert's next pose.
    miss = np.abs(episode.pose[1, :, :3] - episode.target_pose[0, :, :3]).max()
    assert 0.002 < miss < 0.04
    np.testing.assert_array_equal(episode.active_keypoint, np.broadcast_to(episode.keypoints[:, 0], (2, 1, 3)))


def test_keypoints_of_demonstrations_may_be_those_found_in_the_first_picture():
    """The middle of the button is inside it; what is found is on the surface that the camera sees."""
    expert = ScriptedExpert("lamp_on", Settings(batch=2, keypoints="segmentation"))
    episodes = [episode for episode in expert(0, 2) if episode is not None]
    assert episodes
    for episode in episodes:
        start = expert.environment.reset(episode_keys(0, "train", "lamp_on", episode.seed, 1))
        frame, point = decode_frame(episode, 0), episode.keypoints[0, 0]
        camera = Camera(
            jnp.asarray(frame.pictures.camera.intrinsics[0]), jnp.asarray(frame.pictures.camera.world_from_camera[0])
        )
        (u, v), depth = project(jnp.asarray(point), camera)
        assert abs(frame.pictures.depth[0, round(float(v)), round(float(u))] - depth) < 0.01
        away = np.linalg.norm(point - np.asarray(expert.environment.keypoints(start))[0, 0, 0])
        assert 1e-4 < away < 0.03


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("episodes", 0),
        ("workers", 0),
        ("image_size", 0),
        ("seed", -1),
        ("perturb", -0.1),
        ("perturb", np.nan),
        ("perturb_probability", 1.5),
        ("batch", 0),
    ],
)
def test_numbers_of_demonstrations_have_their_range(tmp_path, option, value):
    with pytest.raises(UserError, match=rf"{option}: expected .*, got {value}"):
        Options(out=tmp_path / "new", tasks=("lamp_on",), **{option: value})
    if option != "workers":
        episodes = {"episodes": 1, option: value}
        with pytest.raises(UserError, match=rf"{option}: expected"):
            generate_demonstrations(
                tmp_path / "new", ["lamp_on"], demonstrator=FakeExpert(), progress=False, **episodes
            )
    assert not (tmp_path / "new").exists()


def test_no_tasks_are_no_success(tmp_path):
    with pytest.raises(UserError, match="tasks: expected at least one name, got ','"):
        main(Options(out=tmp_path, tasks=(",",)))


def test_data_made_with_another_reach_of_keypoints_are_refused(folder):
    """How near an arm must come to a keypoint decides which one a frame is told, and which one a policy will be."""
    index = json.loads((folder / "index.json").read_text())
    assert index["reached_radius"] == 0.05
    (folder / "index.json").write_text(json.dumps({**index, "reached_radius": 0.02}))
    with pytest.raises(DataError, match=r"reached_radius: expected 0.05 m, got 0.02; make the data again"):
        EpisodeReader(folder)
