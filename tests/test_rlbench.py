"""RLBench, PerAct and PerAct2 demonstrations: import, and what is refused."""

import io
import pickle
import shutil

import jax.numpy as jnp
import numpy as np
import pytest

from data_pipelines.episodes import EpisodeReader
from data_pipelines.keyframes import discover_keyframes, sample_starts
from data_pipelines.records import decode_frame
from data_pipelines.rlbench.__main__ import Options, Settings, contact_keypoints, import_demonstrations, main
from data_pipelines.rlbench.files import find_episodes, read_recording, unpack_depth
from dsvla_jax.encoding.point_cloud import cloud_from_depth
from dsvla_jax.errors import DataError
from dsvla_jax.geometry.cameras import project
from dsvla_jax.types import Camera
from tests import rlbench_files as files


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    return files.write_dataset(tmp_path_factory.mktemp("rlbench"), ["lamp_on", "bimanual_lift_ball"], size=48)


@pytest.fixture(scope="module")
def imported(source, tmp_path_factory):
    out = tmp_path_factory.mktemp("out")
    assert import_demonstrations(source, out, Settings(), progress=False) == []
    return EpisodeReader(out, verify="sha256")


def test_import_keeps_poses_grippers_and_words(imported):
    assert imported.num_arms == {"bimanual_lift_ball": 2, "lamp_on": 1}
    assert len(imported) == 4
    for number in range(4):
        episode = imported.episode(number)
        pose, gripper, velocity = files.trajectory(arms=episode.num_arms)
        samples = sample_starts(discover_keyframes(gripper, velocity), 10)
        assert [target for _, target in samples] == [16, 16, 22, 22, 32, 32, 39]
        starts, targets = map(list, zip(*samples, strict=True))
        np.testing.assert_allclose(episode.pose, pose[starts], atol=1e-6)
        np.testing.assert_allclose(episode.target_pose, pose[targets], atol=1e-6)
        np.testing.assert_array_equal(episode.gripper_open, gripper[starts])
        np.testing.assert_array_equal(episode.target_gripper, gripper[targets])
        assert episode.instruction == "pick up the red box"
        # Each arm closes at 16, opens at 32 and ends at 39; which of them is next depends on where it has been.
        np.testing.assert_allclose(episode.keypoints, pose[[16, 32, 39]].swapaxes(0, 1)[..., :3], atol=1e-6)
        np.testing.assert_allclose(episode.active_keypoint[0], pose[16, :, :3], atol=1e-6)
        np.testing.assert_allclose(episode.active_keypoint[-1], pose[39, :, :3], atol=1e-6)


def test_arms_keep_their_sides(imported):
    episode = imported.episode(0)
    np.testing.assert_allclose(episode.pose[0, :, 1], [-0.05, 0.05], atol=1e-6)  # as written: left, right


@pytest.mark.parametrize("number", [0, 3])
def test_clouds_line_up_with_their_pictures(imported, number):
    frame = decode_frame(imported.episode(number), 1)
    camera = Camera(
        jnp.asarray(frame.pictures.camera.intrinsics[0]), jnp.asarray(frame.pictures.camera.world_from_camera[0])
    )
    points, valid = cloud_from_depth(frame.pictures.depth[0], camera, (-1.0, -1.0, 0.5), (1.0, 1.0, 2.0))
    points, valid = np.asarray(points), np.asarray(valid)
    assert valid.mean() > 0.5
    pixels = np.asarray(project(points, camera)[0])
    rows, columns = np.divmod(np.arange(len(points)), frame.pictures.rgb[0].shape[1])
    assert np.abs(pixels - np.stack([columns, rows], -1))[valid].max() < 0.01
    # What a point's place in the world says its colour is, is the colour of its pixel. Steps of colour are 2 mm and
    # depth is kept to 0.1 mm, so a point near a step may show the neighbouring one; a pixel is 30 mm.
    shown = frame.pictures.rgb[0].reshape(-1, 3).astype(int)
    step = (files.colour_of(points).astype(int) - shown + 128) % 256 - 128
    assert np.abs(step[valid]).max() <= 1
    assert (step[valid] == 0).mean() > 0.9
    # The table is where it was drawn.
    on_table = valid & (points[:, 2] < files.TABLE + 0.002)
    assert on_table.sum() > 1000
    np.testing.assert_allclose(points[on_table, 2], files.TABLE, atol=2e-4)


def test_depth_is_24_bits_between_near_and_far():
    picture = np.array([[[0, 0, 0], [0, 0, 1], [255, 255, 255], [128, 0, 0]]], np.uint8)
    depth = unpack_depth(picture, 0.0, 1.0)
    np.testing.assert_allclose(depth, [[0, 1 / 16777215, 1, 8388608 / 16777215]], rtol=1e-12)
    np.testing.assert_allclose(unpack_depth(picture, 0.01, 4.5)[0, [0, 2]], [0.01, 4.5])


def test_variation_folders_and_splits(source, tmp_path):
    by_variation = tmp_path / "upstream" / "lamp_on" / "variation7"
    files.write_episode(by_variation / "episodes" / "episode0", frames=8, size=8)
    files.write_episode(by_variation / "episodes" / "episode10", frames=8, size=8)
    files.write_episode(by_variation / "episodes" / "episode2", frames=8, size=8)
    for folder in (by_variation / "episodes").iterdir():
        (folder / "variation_descriptions.pkl").rename(by_variation / "variation_descriptions.pkl")
        (folder / "variation_number.pkl").unlink()
    found = find_episodes(tmp_path / "upstream")
    assert [path.name for path in found["lamp_on"]] == ["episode0", "episode2", "episode10"]
    assert list(find_episodes(tmp_path / "upstream" / "lamp_on")) == ["lamp_on"]
    assert read_recording(found["lamp_on"][0], "lamp_on")[0].instruction == "pick up the red box"

    (tmp_path / "root").mkdir()
    (tmp_path / "root" / "train").symlink_to(source, target_is_directory=True)
    assert sorted(find_episodes(tmp_path / "root")) == ["bimanual_lift_ball", "lamp_on"]
    (tmp_path / "root" / "test").symlink_to(source, target_is_directory=True)
    with pytest.raises(DataError, match=r"expected tasks, or one split, got test, train; import each by itself"):
        find_episodes(tmp_path / "root")
    with pytest.raises(DataError, match=r"expected TASK/all_variations"):
        find_episodes(tmp_path / "nowhere")


def set_value(number, **changes):
    """A `change` of `files.write_episode` for one observation, of the arm's or of the other fields."""

    def change(i, felt, rest):
        if i == number:
            for name, value in changes.items():
                (rest["misc"] if name.startswith("front") else felt[-1])[name] = value

    return change


def truncate(name, share=0.6):
    def damage(folder):
        data = (folder / name).read_bytes()
        (folder / name).write_bytes(data[: int(share * len(data))])

    return damage


def flip_a_bit(name):
    def damage(folder):
        data = bytearray((folder / name).read_bytes())
        data[len(data) // 2] ^= 1
        (folder / name).write_bytes(bytes(data))

    return damage


def rewrite(name, value):
    return lambda folder: files.save_pickle(folder / name, value)


def resize(name):
    return lambda folder: files.save_png(folder / name, np.zeros((4, 8, 3), np.uint8))


WRITTEN_WRONG = {
    "nan pose": (
        set_value(3, gripper_pose=np.array([0.2, np.nan, 1, 0, 1, 0, 0])),
        "low_dim_obs.pkl: observation 3: gripper_pose: expected finite",
    ),
    "no pose": (set_value(3, gripper_pose=None), "low_dim_obs.pkl: observation 3: gripper_pose: expected numbers"),
    "short pose": (
        set_value(3, gripper_pose=np.zeros(6)),
        r"observation 3: gripper_pose: expected numbers \(7,\), got \(6,\)",
    ),
    "words for numbers": (
        set_value(3, gripper_pose=np.array(["a"] * 7)),
        "low_dim_obs.pkl: observation 3: gripper_pose: expected numbers",
    ),
    "no camera": (
        lambda i, felt, rest: rest["misc"].pop("front_camera_near"),
        "low_dim_obs.pkl: observation 0: front_camera_near: expected to be recorded, got nothing",
    ),
    "zero quaternion": (
        set_value(3, gripper_pose=np.zeros(7)),
        "episode0, observation 3: pose: expected a unit quaternion",
    ),
    "nan velocity": (
        set_value(0, joint_velocities=np.full(7, np.inf)),
        "observation 0: joint_velocities: expected finite",
    ),
    "half open": (set_value(2, gripper_open=0.5), "gripper_open: expected 0 .closed. or 1 .open., got 0.5"),
    "nan camera": (
        set_value(1, front_camera_extrinsics=np.full((4, 4), np.nan)),
        "observation 1: front_camera_extrinsics: expected finite",
    ),
    "mirrored camera": (
        set_value(0, front_camera_extrinsics=files.CAMERA * [-1, 1, 1, 1]),
        "observation 0: world_from_camera: expected a rotation, got a mirror",
    ),
    "camera of another size": (
        set_value(0, front_camera_intrinsics=files.intrinsics(128)),
        "observation 0: intrinsics: expected a centre in 16 x 16 pixels",
    ),
}
DAMAGED = {
    "short pickle": (truncate("low_dim_obs.pkl"), "low_dim_obs.pkl: pickle: expected a whole pickle"),
    "foreign class": (
        rewrite("low_dim_obs.pkl", io.BytesIO()),
        r"low_dim_obs.pkl: pickle: expected only .*_io.BytesIO",
    ),
    "reduce payload": (
        lambda folder: (folder / "low_dim_obs.pkl").write_bytes(pickle.dumps(files.Loud(folder / "made"))),
        r"low_dim_obs.pkl: pickle: expected only .*mkdir.*nothing in it was run",
    ),
    "no pickle": (lambda folder: (folder / "low_dim_obs.pkl").unlink(), "low_dim_obs.pkl: file: .*No such file"),
    "no demo": (rewrite("low_dim_obs.pkl", 3), "low_dim_obs.pkl: pickle: expected a Demo"),
    "short picture": (truncate("front_rgb/0.png"), "front_rgb/0.png: picture: expected a whole PNG"),
    "bad picture": (flip_a_bit("front_rgb/0.png"), "front_rgb/0.png: picture: expected the check sums"),
    "short depth": (truncate("front_depth/0.png"), "front_depth/0.png: picture: expected a whole PNG"),
    "empty picture": (truncate("front_depth/0.png", 0), "front_depth/0.png: picture: expected a PNG"),
    "missing frame": (
        lambda folder: (folder / "front_rgb/5.png").unlink(),
        "front_rgb/5.png: file: expected a picture of each of 12",
    ),
    "missing depth": (
        lambda folder: shutil.rmtree(folder / "front_depth"),
        "front_depth: folder: expected 12 pictures, got none",
    ),
    "too many": (
        lambda folder: shutil.copy(folder / "front_depth/0.png", folder / "front_depth/12.png"),
        "front_depth: folder: expected 12 pictures, one an observation, got 13",
    ),
    "another size": (resize("front_depth/0.png"), r"observation 0: depth: expected \(16, 16\) as of rgb, got \(4, 8\)"),
    "no words": (
        rewrite("variation_descriptions.pkl", []),
        "variation_descriptions.pkl: descriptions: expected a list of texts",
    ),
    "no variation": (lambda folder: (folder / "variation_number.pkl").unlink(), "variation_number.pkl: file"),
    "odd variation": (rewrite("variation_number.pkl", "seven"), "variation_number.pkl: variation: expected a number"),
}


@pytest.mark.parametrize("name", [*WRITTEN_WRONG, *DAMAGED])
def test_damaged_episodes_are_named_and_skipped_only_on_request(tmp_path, name):
    change, damage = (WRITTEN_WRONG[name][0], None) if name in WRITTEN_WRONG else (None, DAMAGED[name][0])
    message = {**WRITTEN_WRONG, **DAMAGED}[name][1]
    episodes = tmp_path / "source" / "lamp_on" / "all_variations" / "episodes"
    files.write_episode(episodes / "episode0", frames=12, size=16, change=change)
    files.write_episode(episodes / "episode1", frames=12, size=16)
    if damage:
        damage(episodes / "episode0")
    out = tmp_path / "out"
    with pytest.raises(DataError, match=message) as caught:
        import_demonstrations(tmp_path / "source", out, Settings(), progress=False)
    assert "episode0" in str(caught.value)
    skipped = import_demonstrations(tmp_path / "source", out, Settings(), skip_bad=True, progress=False)
    assert [item["episode"] for item in skipped] == [str(episodes / "episode0")]
    assert skipped[0]["reason"] == str(caught.value)
    reader = EpisodeReader(out)
    assert len(reader) == 1
    assert reader.episode(0).seed == 1


@pytest.mark.parametrize("count", [0, 1])
def test_an_episode_without_steps_is_named(tmp_path, count):
    episodes = tmp_path / "source" / "lamp_on" / "all_variations" / "episodes"
    files.write_episode(episodes / "episode0", frames=4, size=16, demo_change=lambda observations: observations[:count])
    with pytest.raises(DataError, match=rf"episode0/low_dim_obs.pkl: observations: expected at least 2, got {count}"):
        import_demonstrations(tmp_path / "source", tmp_path / "out", Settings(), progress=False)


def test_what_is_left_out_is_counted_and_listed(tmp_path, capsys):
    source = files.write_dataset(tmp_path / "source", ["lamp_on"], episodes=3, frames=12, size=16)
    for number in (0, 2):
        (source / f"lamp_on/all_variations/episodes/episode{number}/front_rgb/5.png").unlink()
    main(Options(source=source, out=tmp_path / "out", skip_bad=True))
    printed = capsys.readouterr().out
    assert "1 episodes (lamp_on 1)" in printed
    assert "left out 2 damaged episodes:" in printed
    for number in (0, 2):
        assert f"episode{number}/front_rgb/5.png: file: expected a picture of each of 12" in printed


def test_what_was_left_out_is_tried_again(tmp_path):
    source = files.write_dataset(tmp_path / "source", ["lamp_on"], episodes=3, frames=12, size=16)
    pickled = source / "lamp_on/all_variations/episodes/episode1/low_dim_obs.pkl"
    whole = pickled.read_bytes()
    pickled.unlink()
    assert len(import_demonstrations(source, tmp_path / "out", Settings(), skip_bad=True, progress=False)) == 1
    with pytest.raises(DataError, match=r"episode1/low_dim_obs\.pkl"):
        import_demonstrations(source, tmp_path / "out", Settings(), progress=False)
    assert len(EpisodeReader(tmp_path / "out")) == 2
    pickled.write_bytes(whole)
    assert import_demonstrations(source, tmp_path / "out", Settings(), progress=False) == []
    assert len(EpisodeReader(tmp_path / "out")) == 3


def test_what_was_imported_is_not_lost(source, tmp_path):
    """Neither to a wish for fewer episodes nor to another split, whose episodes have the same names."""
    import_demonstrations(source, tmp_path / "out", Settings(), progress=False)
    import_demonstrations(source, tmp_path / "out", Settings(), episodes=1, progress=False)
    assert len(EpisodeReader(tmp_path / "out")) == 4
    test = files.write_dataset(tmp_path / "test", ["lamp_on"], episodes=1, frames=12, size=48)
    for other in (test, test / "lamp_on"):
        with pytest.raises(DataError, match=r"out: lamp_on/all_variations/episodes/episode0: .*import each split"):
            import_demonstrations(other, tmp_path / "out", Settings(), progress=False)
    assert len(EpisodeReader(tmp_path / "out", verify="sha256")) == 4


def test_import_goes_on_where_it_stopped(source, tmp_path):
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    import_demonstrations(source, whole, Settings(), progress=False)
    import_demonstrations(source, parts, Settings(), tasks=("lamp_on",), progress=False)
    kept = (parts / "lamp_on-00000.array_record").stat().st_mtime_ns
    import_demonstrations(source, parts, Settings(), progress=False)
    assert (parts / "lamp_on-00000.array_record").stat().st_mtime_ns == kept
    for path in whole.iterdir():
        assert path.read_bytes() == (parts / path.name).read_bytes()
    with pytest.raises(DataError, match=r"settings.every_n: expected 5 as asked for, got 10"):
        import_demonstrations(source, parts, Settings(every_n=5), progress=False)
    with pytest.raises(DataError, match=r"tasks: expected some of bimanual_lift_ball, lamp_on, got lamp_off"):
        import_demonstrations(source, parts, Settings(), tasks=("lamp_off",), progress=False)


def test_without_keypoints(source, tmp_path):
    import_demonstrations(source, tmp_path, Settings(keypoints="none", every_n=0), episodes=1, progress=False)
    for number in range(2):
        episode = EpisodeReader(tmp_path).episode(number)
        assert episode.num_frames == 4
        assert decode_frame(episode, 0).keypoint.shape == (0, 3)


def test_contacts_are_where_grippers_change():
    pose = np.arange(6 * 2 * 7, dtype=float).reshape(6, 2, 7)
    gripper = np.array([[1, 1], [1, 1], [0, 1], [0, 1], [1, 1], [1, 1]], float)
    points = contact_keypoints(pose, gripper)
    np.testing.assert_array_equal(points[0], pose[[2, 4, 5], 0, :3])
    np.testing.assert_array_equal(points[1], pose[[5, 5, 5], 1, :3])
