"""Demonstrations of people's own: what the writer makes of them, and everything that it refuses."""

import dataclasses
import json

import numpy as np
import pytest

from data_pipelines.episodes import EpisodeReader
from data_pipelines.recording import CameraRecording, Recording
from data_pipelines.records import decode_frame
from data_pipelines.writer import DemonstrationWriter
from dsvla_jax.encoding.codec import PoseCodec
from dsvla_jax.errors import DataError, UserError

STEPS, SIZE = 12, 16
SIDE = np.array([[-1, 0, 0, 0.2], [0, -0.6, -0.8, 0.9], [0, -0.8, 0.6, 0.2], [0, 0, 0, 1]])
# Beside the table, looking down at it by 45 degrees; x right and y down in the picture.
HALF = np.sqrt(0.5)
CAMERA = np.array([[0, HALF, -HALF, 0.9], [1, 0, 0, 0], [0, -HALF, -HALF, 1.5], [0, 0, 0, 1]])


def make_recording(**changes):
    rng = np.random.default_rng(0)
    pose = np.tile([0.2, 0, 1.0, 0, 1, 0, 0], (STEPS, 1, 1))
    pose[..., 2] += np.linspace(0, 0.2, STEPS)[:, None]
    gripper = np.ones((STEPS, 1))
    gripper[5:] = 0
    fields = {
        "task": "pick_up",
        "instruction": "pick up the cup",
        "rgb": rng.integers(0, 256, (STEPS, SIZE, SIZE, 3), np.uint8),
        "depth": rng.uniform(0.98, 1.0, (STEPS, SIZE, SIZE)),
        "intrinsics": np.array([[14, 0, 7.5], [0, 14, 7.5], [0, 0, 1.0]]),
        "world_from_camera": CAMERA,
        "pose": pose,
        "gripper_open": gripper,
        "keypoints": np.array([[[0.2, 0, 0.8], [0.3, 0.1, 0.8]]]),
    }
    return Recording(**{**fields, **changes})


def altered(array, place, value):
    array = np.array(array, np.float64)
    array[place] = value
    return array


def mirrored(axis):
    turned = CAMERA.copy()
    turned[:3, axis] *= -1
    return turned


GOOD = make_recording()
WRONG = {
    "float pictures": (
        {"rgb": np.asarray(GOOD.rgb) / 255.0},
        "observation 0: rgb: expected uint8 .*multiply numbers from 0 to 1",
    ),
    "four channels": (
        {"rgb": np.zeros((STEPS, SIZE, SIZE, 4), np.uint8)},
        r"rgb: expected uint8 \(H, W, 3\), got uint8",
    ),
    "grey": ({"rgb": np.zeros((STEPS, SIZE, SIZE), np.uint8)}, r"rgb: expected uint8 \(H, W, 3\)"),
    "sizes": ({"depth": np.ones((STEPS, 8, 16))}, r"depth: expected \(16, 16\) as of rgb, got \(8, 16\); register"),
    "counts": ({"depth": GOOD.depth[:-1]}, "depth: expected 12 pictures, one a pose, got 11"),
    "millimetres": (
        {"depth": (np.asarray(GOOD.depth) * 1000).astype(np.uint16)},
        r"expected metres as floating point, got uint16 .*divide by 1000",
    ),
    "float millimetres": (
        {"depth": np.asarray(GOOD.depth) * 1000},
        "depth: expected metres, got a median of 98.*divide by 1000",
    ),
    "nan depth": (
        {"depth": altered(GOOD.depth, (0, 3, 4), np.nan)},
        "observation 0: depth: expected finite values, got 1 non-finite .*write 0",
    ),
    "negative depth": ({"depth": altered(GOOD.depth, (0, 3, 4), -1)}, "observation 0: depth: expected 0 to 6.5535 m"),
    "no depth": ({"depth": np.zeros((STEPS, SIZE, SIZE))}, "depth: expected some readings, got 0 everywhere"),
    "no camera": (
        {"intrinsics": None},
        r"intrinsics: expected \(3, 3\) or \(12, 3, 3\), got nothing; give the camera's calibration",
    ),
    "no extrinsics": ({"world_from_camera": None}, "world_from_camera: expected .* got nothing"),
    "3 x 4": ({"world_from_camera": CAMERA[:3]}, r"world_from_camera: expected \(4, 4\) or \(12, 4, 4\), got \(3, 4\)"),
    "other size": (
        {"intrinsics": np.array([[28, 0, 16], [0, 28, 16], [0, 0, 1.0]])},
        "intrinsics: expected a centre in 16 x 16 pixels, got .16.0, 16.0.; scale",
    ),
    "transposed intrinsics": (
        {"intrinsics": np.asarray(GOOD.intrinsics).T},
        "intrinsics: expected a pinhole camera's matrix",
    ),
    "no focal length": ({"intrinsics": altered(GOOD.intrinsics, (0, 0), 0)}, "intrinsics: expected a pinhole"),
    "scaled rotation": (
        {"world_from_camera": CAMERA * 1.1},
        "world_from_camera: expected a rotation, got one off by 0.21",
    ),
    "mirrored": ({"world_from_camera": mirrored(0)}, "world_from_camera: expected a rotation, got a mirror image"),
    "transposed": (
        {"world_from_camera": CAMERA.T},
        "world_from_camera: expected a last row 0 0 0 1.*a transposed matrix",
    ),
    "camera in millimetres": (
        {"world_from_camera": altered(CAMERA, (slice(0, 3), 3), [200, 0, 1752])},
        "expected a place in metres",
    ),
    "inverse": (
        {"world_from_camera": np.linalg.inv(SIDE)},
        "keypoints: expected points on things that the camera sees, got .*or is it the inverse",
    ),
    "out of view": (
        {"keypoints": np.array([[[0.2, 2, 0.8]]])},
        "keypoints: expected one in the first 16 x 16 picture, got pixels .*not its inverse",
    ),
    "frame of the robot": (
        {"keypoints": np.array([[[0.2, 0, 0.048]]]), "world_from_camera": CAMERA},
        "keypoints: expected points on things that the camera sees, got 0.52 m between",
    ),
    "decimetres": ({"depth": np.asarray(GOOD.depth) * 0.1}, "keypoints: expected points on things .* got 0.8"),
    "looks away": (
        {"world_from_camera": CAMERA @ np.diag([1, -1, -1, 1.0])},
        r"keypoints\[0, 0\]: expected a point before",
    ),
    "nan keypoint": ({"keypoints": np.full((1, 1, 3), np.nan)}, "keypoints: expected finite"),
    "keypoint shape": ({"keypoints": np.zeros((1, 3))}, r"keypoints: expected \(1, K, 3\)"),
    "nan pose": ({"pose": altered(GOOD.pose, (7, 0, 2), np.nan)}, "observation 7: pose: expected finite numbers"),
    "pose in millimetres": (
        {"pose": np.asarray(GOOD.pose) * ([1000] * 3 + [1] * 4)},
        "pose: expected metres .*divide millimetres",
    ),
    "euler": (
        {"pose": np.concatenate([GOOD.pose[..., :3], np.full((STEPS, 1, 4), 0.9)], -1)},
        "pose: expected a unit quaternion, got length",
    ),
    "no arm axis": ({"pose": GOOD.pose[:, 0]}, r"pose: expected \(T, A, 7\).*pose\[:, None\]"),
    "widths": ({"gripper_open": np.full((STEPS, 1), 0.08)}, "gripper_open: expected 0 .closed. or 1 .open., got 0.08"),
    "gripper shape": ({"gripper_open": np.ones(STEPS)}, r"gripper_open: expected \(12, 1\) as of pose, got \(12,\)"),
    "outside": (
        {"pose": np.add(GOOD.pose, [0, 0, 1.2, 0, 0, 0, 0])},
        r"pose: expected positions from \[-1.0, -1.0, 0.0\] to \[1.0, 1.0, 2.0\]",
    ),
    "no words": ({"instruction": " "}, "instruction: expected words"),
    "path": ({"task": "a/b"}, "task: expected a name for files"),
    "order": ({"channels": "brg"}, "channels: expected rgb or bgr"),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_cannot_be_right_is_refused(tmp_path, name):
    changes, message = WRONG[name]
    with DemonstrationWriter(tmp_path) as writer:
        writer.add(GOOD, keyframes=[5, 11])
        with pytest.raises(DataError, match=message) as caught:
            writer.add(make_recording(**changes), keyframes=[5, 11])
        assert "recording 1 of" in str(caught.value) or "recording 0 of" in str(caught.value)
    assert len(EpisodeReader(tmp_path)) == 1


def test_a_recording_becomes_an_episode(tmp_path):
    with DemonstrationWriter(tmp_path, every_n=4) as writer:
        writer.add(GOOD, keyframes=[5, 11])
    reader = EpisodeReader(tmp_path)
    episode = reader.episode(0)
    starts, targets = [0, 4, 5, 8], [5, 5, 11, 11]
    np.testing.assert_allclose(episode.pose, GOOD.pose[starts], atol=1e-6)
    np.testing.assert_allclose(episode.target_pose, GOOD.pose[targets], atol=1e-6)
    np.testing.assert_array_equal(episode.target_gripper, GOOD.gripper_open[targets])
    np.testing.assert_allclose(episode.world_from_camera[:, 0], np.broadcast_to(CAMERA, (4, 4, 4)), atol=1e-6)
    for place, start in enumerate(starts):
        frame = decode_frame(episode, place)
        np.testing.assert_array_equal(frame.pictures.rgb[0], GOOD.rgb[start])
        np.testing.assert_allclose(frame.pictures.depth[0], GOOD.depth[start], atol=1e-4)
        np.testing.assert_allclose(frame.keypoint, [[0.2, 0, 0.8]], atol=1e-6)


def test_channels_and_quaternions_are_put_right(tmp_path):
    pose = GOOD.pose * ([1] * 3 + [1.005] * 4)
    with DemonstrationWriter(tmp_path) as writer:
        writer.add(make_recording(rgb=np.asarray(GOOD.rgb)[..., ::-1], channels="bgr", pose=pose), keyframes=[5, 11])
    frame = EpisodeReader(tmp_path).frame(0)
    np.testing.assert_array_equal(frame.pictures.rgb[0], GOOD.rgb[0])
    np.testing.assert_allclose(frame.robot.pose[:, 3:], [[0, 1, 0, 0]], atol=1e-6)


def test_keyframes_are_found_or_named(tmp_path):
    moving = np.ones((STEPS, 1, 7))
    with DemonstrationWriter(tmp_path, every_n=0) as writer:
        found = writer.add(GOOD, joint_velocities=moving)
        named = writer.add(GOOD, keyframes=[5, 11])
        np.testing.assert_array_equal(found.target_pose, named.target_pose)
        with pytest.raises(DataError, match="keyframes: expected them or joint_velocities, got neither"):
            writer.add(GOOD)
        with pytest.raises(DataError, match="keyframes: expected them or joint_velocities, got both"):
            writer.add(GOOD, keyframes=[5], joint_velocities=moving)
        with pytest.raises(DataError, match=r"joint_velocities: expected \(12, 1\) and joints, got \(12, 7\)"):
            writer.add(GOOD, joint_velocities=moving[:, 0])
        for wrong in ([], [0, 5], [5, 4], [5, 12]):
            with pytest.raises(DataError, match="keyframes: expected ascending numbers from 1 to 11"):
                writer.add(GOOD, keyframes=wrong)
    assert [EpisodeReader(tmp_path).episode(i).seed for i in range(2)] == [0, 1]


def test_a_folder_grows_and_an_error_keeps_what_was_added(tmp_path):
    def stops():
        with DemonstrationWriter(tmp_path) as writer:
            for _ in range(21):
                writer.add(GOOD, keyframes=[5, 11])
            raise RuntimeError("the robot's log is broken")

    with pytest.raises(RuntimeError, match="broken"):
        stops()
    assert len(EpisodeReader(tmp_path)) == 21
    with DemonstrationWriter(tmp_path) as writer:
        writer.add(GOOD, keyframes=[5, 11])
        writer.add(make_recording(task="put_down"), keyframes=[5, 11])
    reader = EpisodeReader(tmp_path, verify="sha256")
    assert [reader.episode(i).seed for i in (0, 20, 21, 22)] == [0, 20, 21, 0]
    assert reader.tasks == ("pick_up", "put_down")
    index = json.loads((tmp_path / "index.json").read_text())
    (tmp_path / "index.json").write_text(json.dumps({**index, "settings": {"seed": 0}}))
    with pytest.raises(DataError, match="expected recordings, got demonstrations of another origin"):
        DemonstrationWriter(tmp_path)


def test_sizes_do_not_mix(tmp_path):
    small = make_recording(
        rgb=np.asarray(GOOD.rgb)[:, :8, :8], depth=np.asarray(GOOD.depth)[:, :8, :8], task="put_down"
    )
    with DemonstrationWriter(tmp_path) as writer:
        writer.add(GOOD, keyframes=[5, 11])
        writer.add(small, keyframes=[5, 11])
    with pytest.raises(DataError, match=r"picture size: expected one .*, got \[\(8, 8\), \(16, 16\)\]"):
        EpisodeReader(tmp_path)
    assert len(EpisodeReader(tmp_path, tasks=["pick_up"])) == 1


def test_another_box_takes_other_poses(tmp_path):
    high = dataclasses.replace(GOOD, pose=np.add(GOOD.pose, [0, 0, 1.2, 0, 0, 0, 0]), keypoints=None)
    with DemonstrationWriter(tmp_path, codec=PoseCodec(high=(1.0, 1.0, 3.0))) as writer:
        writer.add(high, keyframes=[5, 11])
    assert EpisodeReader(tmp_path).frame(0).keypoint.shape == (0, 3)


def test_where_joints_rest_can_be_chosen_and_is_kept(tmp_path, capsys):
    speeds = np.ones((STEPS, 1, 7))
    speeds[8] = 0.05
    with DemonstrationWriter(tmp_path, every_n=0) as writer:
        assert writer.add(GOOD, joint_velocities=speeds).num_frames == 3
    assert not capsys.readouterr().err
    with DemonstrationWriter(tmp_path, every_n=0, still=0.01) as writer:
        assert writer.add(GOOD, joint_velocities=speeds).num_frames == 2
        with pytest.raises(
            DataError, match=r"joint_velocities: expected radians per second, got 57.3 .* divide degrees"
        ):
            writer.add(GOOD, joint_velocities=np.rad2deg(speeds))
    assert "in 1 of 1 recordings the joints never all rest (below 0.01 rad/s)" in capsys.readouterr().err
    shards = json.loads((tmp_path / "index.json").read_text())["shards"]
    assert [shard["made_with"] for shard in shards] == [
        {"every_n": 0, "still": 0.1, "stop_buffer": 4},
        {"every_n": 0, "still": 0.01, "stop_buffer": 4},
    ]


def test_a_camera_on_the_wrist_need_not_see_the_keypoints(tmp_path):
    """One that stands still and looks away is refused: see `looks away`."""
    away = np.tile(CAMERA @ np.diag([1, -1, -1, 1.0]), (STEPS, 1, 1))
    away[:, 2, 3] += np.linspace(0, 0.2, STEPS)
    with DemonstrationWriter(tmp_path) as writer:
        writer.add(make_recording(world_from_camera=away), keyframes=[5, 11])
    np.testing.assert_allclose(EpisodeReader(tmp_path).episode(0).keypoints, np.array(GOOD.keypoints), atol=1e-6)


@pytest.mark.parametrize("option", [{"every_n": -1}, {"still": -0.1}, {"still": np.nan}, {"stop_buffer": -1}])
def test_numbers_of_the_writer_have_their_range(tmp_path, option):
    with pytest.raises(UserError, match=f"{next(iter(option))}: expected at least 0"):
        DemonstrationWriter(tmp_path / "new", **option)
    assert not (tmp_path / "new").exists()


def test_a_second_camera_is_recorded_and_checked_by_its_name(tmp_path):
    rng = np.random.default_rng(1)
    wrist = CameraRecording(
        list(rng.integers(0, 256, (STEPS, SIZE, SIZE, 3), np.uint8)),
        list(rng.uniform(0.15, 0.25, (STEPS, SIZE, SIZE))),
        GOOD.intrinsics,
        np.stack([np.diag([1, -1, -1, 1.0])] * STEPS),
    )
    wrist.world_from_camera[:, :3, 3] = np.asarray(GOOD.pose)[:, 0, :3] + np.linspace(0, 0.1, STEPS)[:, None]
    both = make_recording(other_cameras={"wrist": wrist})
    with DemonstrationWriter(tmp_path / "two", every_n=3) as writer:
        episode = writer.add(both, keyframes=[5, 11])
        with pytest.raises(DataError, match=r"cameras: expected front, wrist, as in .*, got one camera; record with"):
            writer.add(GOOD, keyframes=[5, 11])
    reader = EpisodeReader(tmp_path / "two")
    assert reader.cameras == episode.cameras == ("front", "wrist")
    frame = decode_frame(reader.episode(0), 1)
    np.testing.assert_array_equal(frame.pictures.rgb, [GOOD.rgb[3], wrist.rgb[3]])
    np.testing.assert_allclose(frame.pictures.camera.world_from_camera[1], wrist.world_from_camera[3], atol=1e-6)
    wrong = {
        "observation 0, camera wrist: rgb: expected uint8": {"rgb": np.asarray(wrist.rgb) / 255.0},
        "camera wrist: depth: expected 12 pictures": {"depth": wrist.depth[:5]},
        "camera wrist: world_from_camera: .*mirror image": {"world_from_camera": mirrored(0)},
        "picture size: expected one .* for all cameras": {
            "rgb": [one[:8, :8] for one in wrist.rgb],
            "depth": [one[:8, :8] for one in wrist.depth],
        },
    }
    for complaint, changes in wrong.items():
        bad = make_recording(other_cameras={"wrist": dataclasses.replace(wrist, **changes)})
        with DemonstrationWriter(tmp_path / "bad") as writer, pytest.raises(DataError, match=complaint):
            writer.add(bad, keyframes=[5, 11])
    with DemonstrationWriter(tmp_path / "bad") as writer, pytest.raises(DataError, match="expected different names"):
        writer.add(make_recording(other_cameras={"front": wrist}), keyframes=[5, 11])
