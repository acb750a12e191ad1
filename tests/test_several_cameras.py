"""Demonstrations of several cameras: recorded, stored, read by the cameras' names, varied and looked at."""

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest

from data_pipelines import augment
from data_pipelines.demos import ScriptedExpert, Settings, generate_demonstrations
from data_pipelines.episodes import INDEX_FILE, EpisodeReader, read_index, write_episodes, write_index
from data_pipelines.first_look import look_at_demonstrations
from data_pipelines.inspect.drawing import draw_frame, frame_cloud
from data_pipelines.learned_from import learned_from
from data_pipelines.pictures import random_box
from data_pipelines.records import decode_frame, pack_episode, unpack_episode
from data_pipelines.sources import require_data_fits
from dsvla_jax.data_config import DataConfig
from dsvla_jax.encoding.config import EncodingConfig
from dsvla_jax.encoding.text import WordTokenizer, vocabulary
from dsvla_jax.errors import DataError, UserError
from dsvla_jax.types import split_cameras
from tests.random_data import random_episode, seen_by_random_cameras

NAMES = ("front", "wrist", "overhead")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two episodes of three cameras."""
    write_episodes(tmp_path / "data", [seen_by_random_cameras(seed, NAMES) for seed in range(2)])
    return tmp_path / "data"


def test_a_record_keeps_all_cameras_and_one_of_a_single_camera_has_no_camera_axis():
    several = seen_by_random_cameras(0, NAMES, frames=3)
    again = unpack_episode(pack_episode(several))
    for field in dataclasses.fields(several):
        np.testing.assert_array_equal(getattr(again, field.name), getattr(several, field.name))
    assert (again.num_frames, again.num_cameras, len(again.rgb_png)) == (3, 3, 9)
    fields = msgpack.unpackb(pack_episode(random_episode(0, frames=3)), raw=False)
    assert "cameras" not in fields
    assert fields["intrinsics"]["shape"] == [3, 3, 3]
    assert fields["world_from_camera"]["shape"] == [3, 4, 4]
    assert decode_frame(random_episode(0), 1).pictures.camera.intrinsics.shape == (1, 3, 3)


def test_every_frame_has_the_pictures_of_its_own_moment(folder):
    episode = seen_by_random_cameras(1, NAMES)
    for place in range(episode.num_frames):
        pictures = EpisodeReader(folder).frame(episode.num_frames + place).pictures
        expected = decode_frame(episode, place).pictures
        assert pictures.rgb.shape == (3, 8, 8, 3)
        np.testing.assert_array_equal(pictures.rgb, expected.rgb)
        np.testing.assert_array_equal(pictures.depth, expected.depth)
    assert len(set(episode.rgb_png)) == 9


def test_cameras_are_chosen_by_name_in_any_order(folder):
    whole, chosen = EpisodeReader(folder), EpisodeReader(folder, cameras=("overhead", "front"))
    assert (whole.cameras, chosen.cameras) == (NAMES, ("overhead", "front"))
    everything, some = whole.frame(2).pictures, chosen.frame(2).pictures
    np.testing.assert_array_equal(some.rgb, everything.rgb[[2, 0]])
    np.testing.assert_array_equal(some.depth, everything.depth[[2, 0]])
    np.testing.assert_array_equal(some.camera.world_from_camera, everything.camera.world_from_camera[[2, 0]])
    only = EpisodeReader(folder, cameras=("wrist",)).episode(0)
    assert (only.cameras, only.num_frames) == ((), 3)
    assert unpack_episode(pack_episode(only)).rgb_png == only.rgb_png
    for wrong in (("side",), ("front", "front"), ()):
        with pytest.raises(DataError, match=r"cameras: expected some of front, wrist, overhead, each once, got"):
            EpisodeReader(folder, cameras=wrong)


def test_front_stands_for_the_only_camera_of_a_folder(tmp_path):
    write_episodes(tmp_path / "mine", [random_episode(0)])
    assert EpisodeReader(tmp_path / "mine", cameras=("front",)).cameras == ()
    with pytest.raises(
        DataError, match=r"one camera, whose name is not known, .*got wrist; leave data.cameras at front"
    ):
        EpisodeReader(tmp_path / "mine", cameras=("wrist",))
    write_episodes(tmp_path / "named", [random_episode(0)], settings={"camera": "left_shoulder"})
    for wanted in (None, ("front",), ("left_shoulder",)):
        assert EpisodeReader(tmp_path / "named", cameras=wanted).cameras == ("left_shoulder",)
    with pytest.raises(DataError, match="expected some of left_shoulder, each once, got front, left_shoulder"):
        EpisodeReader(tmp_path / "named", cameras=("front", "left_shoulder"))


def test_folders_of_unlike_cameras_are_refused(tmp_path, folder):
    with pytest.raises(DataError, match="cameras: expected the same for all"):
        write_episodes(tmp_path / "other", [seen_by_random_cameras(0, NAMES), random_episode(1)])
    index = read_index(folder)
    (shard,) = index["shards"]
    other = shard.copy()
    other["task"] = "other"
    del other["cameras"]
    write_index(folder, [shard, other])
    with pytest.raises(DataError, match=r"cameras: expected the same for all episodes.*a folder for each set"):
        EpisodeReader(folder)


def test_all_cameras_move_with_the_world_and_each_is_cropped_and_coloured_by_itself():
    frame = decode_frame(seen_by_random_cameras(0, NAMES, size=64), 1)
    offset = np.array([0.1, -0.2, 0.0], np.float32)
    moved = augment.shift_world(frame, offset).pictures.camera.world_from_camera
    np.testing.assert_allclose(
        moved[:, :3, 3] - frame.pictures.camera.world_from_camera[:, :3, 3], [offset] * 3, atol=1e-6
    )
    cropped = augment.random_crop(frame, np.random.default_rng(3), 0.5)
    rng = np.random.default_rng(3)
    boxes = [random_box(rng, 64, 64, 0.5) for _ in NAMES]
    assert len(set(boxes)) == 3
    for box, one, seen in zip(boxes, split_cameras(frame.pictures), split_cameras(cropped.pictures), strict=True):
        expected = augment.crop(one, *box)
        np.testing.assert_array_equal(seen.rgb, expected.rgb)
        np.testing.assert_array_equal(seen.depth, expected.depth)
        np.testing.assert_array_equal(seen.camera.intrinsics, expected.camera.intrinsics)
    grey = dataclasses.replace(frame.pictures, rgb=np.full_like(frame.pictures.rgb, 128))
    varied = augment.vary_colour(dataclasses.replace(frame, pictures=grey), np.random.default_rng(0), 0.3)
    assert len({int(rgb[0, 0, 0]) for rgb in varied.pictures.rgb}) == 3


def test_the_first_of_several_cameras_is_varied_as_an_only_one_is():
    several = decode_frame(seen_by_random_cameras(0, NAMES, size=64), 1)
    alone = dataclasses.replace(several, pictures=_first(several.pictures))
    variations: list[Callable[..., Any]] = [augment.random_crop, augment.vary_colour]
    for vary in variations:
        one, other = (vary(x, np.random.default_rng(5), 0.5).pictures for x in (alone, several))
        np.testing.assert_array_equal(one.rgb[0], other.rgb[0])


def _first(pictures: Any) -> Any:
    return augment.join_cameras(split_cameras(pictures)[:1])


def test_inspection_shows_all_cameras(folder):
    frame = EpisodeReader(folder).frame(0)
    drawn = draw_frame(frame)
    assert drawn.shape == (3 * 8, 8, 3)
    points, colours = frame_cloud(frame)
    assert len(points) == len(colours) == 3 * 64


def test_a_camera_that_sees_nothing_of_the_workspace_is_named(tmp_path):
    wide = EncodingConfig(workspace_low=(-9, -9, -9), workspace_high=(9, 9, 9))
    episode = seen_by_random_cameras(0, ("front", "wrist"), size=64)
    write_episodes(tmp_path / "good", [episode])
    said = look_at_demonstrations(EpisodeReader(tmp_path / "good"), wide)
    assert "2,048 of 2,048 points in the workspace (mean of 3 samples)" in said
    poses = episode.world_from_camera.copy()
    poses[:, 1, :3, 3] = 15
    write_episodes(tmp_path / "bad", [dataclasses.replace(episode, world_from_camera=poses)])
    with pytest.raises(DataError, match=r"lamp_on: camera wrist: expected a reading in the workspace .*, got 0 of"):
        look_at_demonstrations(EpisodeReader(tmp_path / "bad"), wide)


def test_an_expert_is_recorded_by_two_cameras_and_by_one_as_before(tmp_path):
    """What the front camera sees, does and is stored as does not depend on the wrist camera."""
    # In pictures as small, objects are not seen.
    options: dict[str, Any] = {"image_size": 24, "batch": 2, "keypoints": "oracle"}
    for name, cameras in (("two", ("wrist", "front")), ("one", ("front",))):
        expert = ScriptedExpert("lamp_on", Settings(cameras=cameras, **options))
        generate_demonstrations(
            tmp_path / name,
            ["lamp_on"],
            2,
            demonstrator=lambda *_, expert=expert: expert,
            progress=False,
            cameras=cameras,
            **options,
        )
    two, one = EpisodeReader(tmp_path / "two"), EpisodeReader(tmp_path / "one")
    assert (two.cameras, one.cameras) == (("wrist", "front"), ("front",))
    assert pack_episode(EpisodeReader(tmp_path / "two", cameras=("front",)).episode(1)) == pack_episode(one.episode(1))
    wrist = two.episode(1).world_from_camera[:, 0, :3, 3]
    hands = two.episode(1).pose[:, 0, :3]
    np.testing.assert_allclose(np.linalg.norm(wrist - hands, axis=1), np.hypot(0.041, 0.0975), atol=1e-3)
    # A folder of the front camera alone is as it was before there were others.
    assert "cameras" not in json.loads((tmp_path / "one" / INDEX_FILE).read_text())["settings"]
    with pytest.raises(DataError, match=r"settings.cameras: expected \['front'\] as asked for"):
        generate_demonstrations(tmp_path / "two", ["lamp_on"], 2, progress=False, cameras=("front",), **options)
    data = DataConfig(folder=str(tmp_path / "two"), tasks=("lamp_on",), cameras=("front", "wrist"), episodes=2)
    assert learned_from(data, use_keypoints=True).cameras == ("front", "wrist")


def test_the_simulators_cameras_are_known_before_anything_is_made(tmp_path):
    tokenizer, encoding = WordTokenizer(vocabulary(["turn on the light"])), EncodingConfig()
    data = DataConfig(folder=str(tmp_path / "new"), tasks=("bimanual_lift_ball",), cameras=("front", "wrist"))
    with pytest.raises(UserError, match=r"cameras: expected some of .*wrist_left, wrist_right.*2 arm"):
        require_data_fits(data, encoding, tokenizer)
    assert not (tmp_path / "new").exists()
