"""RLBench's data as people have them: some cameras, some pictures, other rests, archives of macOS."""

import json
import re
import shutil

import numpy as np
import pytest

from data_pipelines.episodes import EpisodeReader
from data_pipelines.rlbench.__main__ import Options, Settings, import_demonstrations, main
from data_pipelines.rlbench.files import find_episodes, read_recording
from dsvla_jax.errors import DataError, UserError
from tests import rlbench_files as files
from tests.test_data import assert_equal_episodes

SIZE, FRAMES = 16, 40


def write_source(root, change=None, episodes=1, frames=FRAMES):
    return files.write_dataset(root, ["lamp_on"], episodes=episodes, frames=frames, size=SIZE, change=change)


def episode_folder(source, number=0):
    return source / "lamp_on" / "all_variations" / "episodes" / f"episode{number}"


def imported(source, out, **settings):
    assert import_demonstrations(source, out, Settings(**settings), progress=False) == []
    return EpisodeReader(out)


def on_the_wrist(number, felt, rest):
    """A camera that moves with the hand and looks at the horizon, so that it sees no place where the hand acts."""
    matrix = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])
    matrix[:3, 3] = felt[0]["gripper_pose"][:3]
    front = {name: rest["misc"][name] for name in rest["misc"] if name.startswith("front")}
    rest["misc"] |= {name.replace("front", "wrist"): value for name, value in front.items()}
    rest["misc"]["wrist_camera_extrinsics"] = matrix


def add_wrist_pictures(folder):
    for kind in ("rgb", "depth"):
        shutil.copytree(folder / f"front_{kind}", folder / f"wrist_{kind}")


def test_a_camera_on_the_wrist_need_not_see_where_the_hand_acts(tmp_path):
    source = write_source(tmp_path / "source", on_the_wrist, episodes=2)
    for number in range(2):
        add_wrist_pictures(episode_folder(source, number))
    reader = imported(source, tmp_path / "out", cameras=("wrist",))
    assert len(reader) == 2
    pose, _, _ = files.trajectory(FRAMES)
    np.testing.assert_allclose(reader.episode(0).keypoints[0], pose[[16, 32, 39], 0, :3], atol=1e-6)


def test_a_camera_that_stands_still_and_sees_no_keypoint_is_refused_with_the_way_out(tmp_path):
    def look_away(number, felt, rest):
        rest["misc"]["front_camera_extrinsics"] = files.CAMERA @ np.diag([1, -1, -1, 1.0])

    source = write_source(tmp_path / "source", look_away)
    with pytest.raises(DataError, match=r"episode0: keypoints.*choose another --cameras, or import without keypoints"):
        import_demonstrations(source, tmp_path / "out", Settings(), progress=False)
    assert len(imported(source, tmp_path / "out", keypoints="none")) == 1


def test_a_camera_that_is_not_there_is_answered_by_those_that_are(tmp_path):
    source = write_source(tmp_path / "source", on_the_wrist)
    with pytest.raises(DataError, match="expected one of front, wrist, got 'wirst'; choose one with --cameras"):
        import_demonstrations(source, tmp_path / "out", Settings(cameras=("wirst",)), progress=False)
    with pytest.raises(
        DataError, match=r"wrist_rgb: folder: expected 40 pictures, got none, but those of front; choose"
    ):
        import_demonstrations(source, tmp_path / "out", Settings(cameras=("wrist",)), progress=False)


def keep_pictures(folder, numbers):
    for kind in ("rgb", "depth"):
        for path in (folder / f"front_{kind}").iterdir():
            if int(path.stem) not in numbers:
                path.unlink()


def test_a_copy_with_the_pictures_of_keyframes_only(tmp_path):
    """Keyframes are 16, 22, 32 and 39; the last one is gone to, and not looked at."""
    source = write_source(tmp_path / "source")
    whole = imported(source, tmp_path / "whole", every_n=0)
    keep_pictures(episode_folder(source), {0, 16, 22, 32})
    with pytest.raises(
        DataError,
        match=r"front_rgb: folder: expected pictures of all 40 observations, got 4 \(no 1.png\); if they are those of "
        r"keyframes, import with --every-n 0",
    ):
        import_demonstrations(source, tmp_path / "out", Settings(), progress=False)
    assert_equal_episodes(imported(source, tmp_path / "out", every_n=0).episode(0), whole.episode(0))
    (episode_folder(source) / "front_rgb" / "22.png").unlink()
    with pytest.raises(
        DataError, match=r"front_rgb/22.png: file: expected a picture of the first observation and of each"
    ):
        import_demonstrations(source, tmp_path / "again", Settings(every_n=0), progress=False)


def test_pictures_may_have_leading_zeros_but_begin_at_0(tmp_path):
    source = write_source(tmp_path / "source")
    before = imported(source, tmp_path / "before").episode(0)
    for shift in (0, 1):
        for kind in ("rgb", "depth"):
            for path in sorted((episode_folder(source) / f"front_{kind}").iterdir(), reverse=True):
                path.rename(path.with_name(f"{int(path.stem) + shift:05d}.png"))
        if not shift:
            assert_equal_episodes(imported(source, tmp_path / "zeros").episode(0), before)
    with pytest.raises(DataError, match=r"front_rgb: folder: expected pictures 0 to 39, got 1 to 40; number the files"):
        import_demonstrations(source, tmp_path / "shifted", Settings(), progress=False)


def test_hidden_files_of_macos_archives_are_no_pictures(tmp_path):
    source = write_source(tmp_path / "source")
    for path in [*episode_folder(source).glob("*/*.png"), episode_folder(source) / "low_dim_obs.pkl"]:
        path.with_name(f"._{path.name}").write_bytes(b"Mac OS X")
    assert len(imported(source, tmp_path / "out")) == 1


def test_where_a_robot_counts_as_resting_can_be_chosen_and_is_kept(tmp_path):
    """The fixture's joints move by 0.01 rad/s where it pauses, at observation 22."""
    source = write_source(tmp_path / "source")
    found = imported(source, tmp_path / "found", every_n=0).episode(0)
    missed = imported(source, tmp_path / "missed", every_n=0, still=0.001)
    assert (found.num_frames, missed.episode(0).num_frames) == (4, 3)
    assert missed.settings["still"] == 0.001
    # A folder from before this was an option was made with PerAct's.
    index = json.loads((tmp_path / "found" / "index.json").read_text())
    for name in ("still", "stop_buffer"):
        del index["settings"][name]
    (tmp_path / "found" / "index.json").write_text(json.dumps(index))
    imported(source, tmp_path / "found", every_n=0)
    with pytest.raises(DataError, match=r"settings.still: expected 0.001 as asked for, got 0.1"):
        imported(source, tmp_path / "found", every_n=0, still=0.001)


def test_degrees_per_second_are_refused(tmp_path):
    def degrees(number, felt, rest):
        felt[0]["joint_velocities"] = np.rad2deg(felt[0]["joint_velocities"])

    source = write_source(tmp_path / "source", degrees)
    with pytest.raises(DataError, match=r"joint_velocities: expected radians per second, got 28.6 .* divide degrees"):
        import_demonstrations(source, tmp_path / "out", Settings(), progress=False)


def test_the_variation_is_kept_and_what_is_left_aside_is_said(tmp_path, capsys):
    source = write_source(tmp_path / "source", episodes=2)
    files.save_pickle(episode_folder(source, 1) / "variation_number.pkl", 5)
    files.save_png(episode_folder(source) / "front_mask" / "0.png", np.zeros((4, 4, 3), np.uint8))
    main(Options(source=source, out=tmp_path / "out", still=0.001))
    assert [EpisodeReader(tmp_path / "out").episode(number).variation for number in range(2)] == [3, 5]
    assert capsys.readouterr().out.splitlines() == [
        f"{tmp_path / 'out'}: 2 episodes (lamp_on 2) of 2 variations, 12 samples",
        "in 2 of them the joints never rest: keyframes are changes of a gripper and the end (--still)",
        "left aside, folder (episodes): front_mask (1); masks do not say of which object they are",
    ]
    by_variation = tmp_path / "upstream" / "lamp_on" / "variation7" / "episodes" / "episode0"
    files.write_episode(by_variation, frames=8, size=8)
    (by_variation / "variation_number.pkl").unlink()
    (folder,) = find_episodes(tmp_path / "upstream")["lamp_on"]
    assert read_recording(folder, "lamp_on")[0].variation == 7


@pytest.mark.parametrize(
    ("option", "value"),
    [("every_n", -1), ("still", -0.1), ("stop_buffer", -1), ("episodes", 0), ("episodes", -3), ("cameras", ("",))],
)
def test_numbers_of_the_import_have_their_range(tmp_path, option, value):
    with pytest.raises(UserError, match=rf"{option}: expected .*, got {re.escape(str(value))}"):
        Options(source=tmp_path, out=tmp_path / "new", **{option: value})


def test_two_cameras_are_imported_in_the_order_of_their_names(tmp_path, capsys):
    """One of two that stand still must see a keypoint; the wrist camera moves, and never sees one."""
    source = write_source(tmp_path / "source", on_the_wrist)
    add_wrist_pictures(episode_folder(source))
    reader = imported(source, tmp_path / "out", cameras=("wrist", "front"))
    assert reader.cameras == ("wrist", "front")
    assert reader.settings["cameras"] == ["wrist", "front"]
    front = imported(source, tmp_path / "front").episode(0)
    assert_equal_episodes(EpisodeReader(tmp_path / "out", cameras=("front",)).episode(0), front)
    np.testing.assert_array_equal(reader.frame(0).pictures.rgb[0], reader.frame(0).pictures.rgb[1])
    moved = reader.episode(0).world_from_camera[:, 0, :3, 3]
    np.testing.assert_allclose(moved, reader.episode(0).pose[:, 0, :3], atol=1e-6)
    main(Options(source=source, out=tmp_path / "out", cameras=("wrist", "front")))
    assert "left aside" not in capsys.readouterr().out
    with pytest.raises(DataError, match=r"settings.camera: expected 'front' as asked for, got None"):
        import_demonstrations(source, tmp_path / "out", Settings(), progress=False)
