"""Looking at data: what is printed and drawn of folders whose contents are known."""

import base64
import dataclasses
import re

import cv2
import numpy as np
import pytest
from rich.console import Console

from data_pipelines.episodes import write_episodes
from data_pipelines.inspect.__main__ import Options, describe, main
from data_pipelines.inspect.page import print_page
from data_pipelines.recording import Recording, make_demonstration
from dsvla_jax.errors import DataError
from tests import rlbench_files as files

BOX_TOP = np.array([0.25, 0.0, 0.9])


def make_episode(number=0, **changes):
    """The arm of the synthetic RLBench episodes over the box, with its keypoint on the box."""
    pose, gripper, _ = files.trajectory(frames=12)
    rgb, depth = files.render(48)
    recording = Recording(
        task="lamp_on",
        instruction="press the <red> box",
        rgb=[rgb] * 12,
        depth=[np.where(depth < 3, depth, 0)] * 12,
        intrinsics=files.intrinsics(48),
        world_from_camera=files.CAMERA,
        pose=pose,
        gripper_open=gripper,
        keypoints=BOX_TOP[None, None],
    )
    return make_demonstration(dataclasses.replace(recording, **changes), [(0, 4), (4, 9), (9, 11)], number)


def look(folder, episodes, **options):
    write_episodes(folder, episodes)
    return describe(Options(str(folder), **options))[0]


def table(page, caption):
    (found,) = [table for table in page.tables if table.caption.startswith(caption)]
    return {row[0]: row[1:] for row in found.rows}


def test_counts_features_and_statistics_are_those_of_the_folder(tmp_path):
    page = look(tmp_path, [make_episode(i) for i in range(4)])
    assert page.title.endswith("4 episodes, 12 samples")
    assert page.warnings == []
    assert table(page, "counts")["lamp_on"] == ("1", "4", "12", "3.0", "1", "1")
    said = table(page, "what training says")
    assert said["instructions"] == ("4 of 4 episodes have an instruction",)
    assert said["targets"] == ("2 of 8 components of the targets vary (constant: x, y, qx, qy, qz, qw)",)
    assert table(page, "features")["depth"] == ("float32", "48 x 48", "m, 0: no reading")
    statistics = table(page, "statistics")
    heights = files.trajectory(frames=12)[0][[4, 9, 11], 0, 2]
    expected = (heights.mean(), heights.std(), heights.min(), np.median(heights), heights.max())
    np.testing.assert_allclose([float(x) for x in statistics["target z (m)"]], expected, rtol=0.005)
    depth = files.render(48)[1]
    np.testing.assert_allclose(float(statistics["nearest depth (m)"][0]), depth.min(), rtol=0.005)
    np.testing.assert_allclose(float(statistics["pixels without depth (%)"][0]), 100 * (depth >= 3).mean(), rtol=0.01)
    assert float(statistics["keypoint to what is seen (m)"][4]) < 0.02


def test_the_page_shows_frames_clouds_prompts_and_answers(tmp_path, capsys):
    write_episodes(tmp_path, [make_episode(i) for i in range(4)])
    main(Options(str(tmp_path), episodes=2))
    assert "page: " in capsys.readouterr().out
    text = (tmp_path / "inspect.html").read_text()
    assert text.count("<h2>") == 2
    assert "press the &lt;red&gt; box" in text
    assert "near 25 0 90:" in text
    assert "http" not in text
    pictures = re.findall(r"base64,([^\"]+)\"", text)
    assert len(pictures) == 2 * 3
    strip = cv2.imdecode(np.frombuffer(base64.b64decode(pictures[0]), np.uint8), cv2.IMREAD_COLOR)
    assert strip is not None
    assert strip.shape == (48, 3 * 48 + 2 * 2, 3)
    # The cross of the keypoint and the ring of the target are where the camera sees them.
    point = np.linalg.inv(files.CAMERA) @ np.append(BOX_TOP, 1)
    u, v = np.rint((files.intrinsics(48) @ point[:3])[:2] / point[2]).astype(int)
    np.testing.assert_array_equal(strip[v, u], [0, 220, 255])


@pytest.mark.parametrize(
    ("changes", "warning"),
    [
        ({"gripper_open": np.ones((12, 1))}, "no gripper ever changes"),
        ({"pose": files.trajectory(12)[0] + [0, 1.2, 0, 0, 0, 0, 0]}, r"100.0 % of the targets are outside of the box"),
        ({"pose": np.tile(files.trajectory(12)[0][:1], (12, 1, 1))}, r"33 % of the samples ask for no motion"),
        ({"keypoints": BOX_TOP[None, None] + [0, 0, 0.3]}, r"half of the keypoints are 0.3\d m or more from"),
        ({"depth": [np.pad(np.ones((4, 4)), 22)] * 12}, r"99 % of the pixels have no depth"),
        (
            {"depth": [np.full((48, 48), 2.9)] * 12},
            r"3D input: lamp_on: depth: expected at least 2% of the",
        ),
    ],
)
def test_what_is_mostly_a_mistake_is_warned_of(tmp_path, changes, warning):
    page = look(tmp_path, [make_episode(**changes)])
    assert any(re.search(warning, text) for text in page.warnings), page.warnings


def test_printing_takes_brackets_as_they_are(tmp_path):
    page = look(tmp_path, [make_episode(instruction="press [red] the [bold]box")])
    console = Console(record=True, width=120, file=open("/dev/null", "w"))  # noqa: SIM115
    print_page(page, console)
    assert "press [red] the [bold]box" in console.export_text()


def test_other_folders_are_refused_with_what_to_do(tmp_path):
    with pytest.raises(DataError, match=r"expected demonstrations .*docs/data_own.md"):
        describe(Options(str(tmp_path)))
    (tmp_path / "lamp_on" / "all_variations" / "episodes" / "episode0").mkdir(parents=True)
    with pytest.raises(DataError, match=r"import them first: python -m data_pipelines.rlbench"):
        describe(Options(str(tmp_path)))
