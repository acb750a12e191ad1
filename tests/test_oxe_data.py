"""Mixtures: targets, texts, pictures and depth of samples whose motion is known, and what is refused."""

import dataclasses

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from data_pipelines.oxe.__main__ import vocabulary as write_words
from data_pipelines.oxe.fixtures.builds.maniskill import DEPTH_COUNTS, camera_from_world
from data_pipelines.oxe.fixtures.write import write_fixture
from data_pipelines.oxe.loader import OxeLoader
from data_pipelines.oxe.motion import Motion
from data_pipelines.oxe.registry import get_dataset
from data_pipelines.oxe.targets import keyframes, make_targets
from data_pipelines.pictures import crop_intrinsics, crop_resize, random_box, vary_light
from dsvla_jax.data_config import OxeConfig
from dsvla_jax.encoding.codec import PoseCodec
from dsvla_jax.encoding.displacement import DisplacementScale, displace
from dsvla_jax.encoding.pretrained_tokenizers import load_tokenizer
from dsvla_jax.encoding.text import WordTokenizer, vocabulary
from dsvla_jax.errors import UserError
from dsvla_jax.suite_vocabulary import suite_tokenizer
from tests.oxe_mixtures import (
    ENCODING,
    FIVE,
    MANISKILL,
    answer_of,
    config_for,
    make,
    names_of,
    scale_of,
    truth_of,
    write_datasets,
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_datasets(tmp_path_factory.mktemp("oxe"))


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
        prompt = batch.text.mask[row] & ~batch.answer_mask[row]
        text = suite_tokenizer().decode([int(token) for token in batch.text.tokens[row][prompt]][1:])
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
    for rgb, place in zip(next(loader).pictures.rgb[:, 0], places, strict=True):
        known, step = truth_of(name, place.where)
        red, green, blue = known.colour(step)
        expected = (blue, green, red) if mended else (red, green, blue)
        assert np.abs(rgb.astype(int) - expected).max() <= 3


def test_keyframes_are_gripper_changes_rests_and_the_end():
    positions = np.cumsum([0, 1, 1, 0, 0, 0, 1, 1, 1, 1, 1, 1], dtype=float) * 0.05
    pose = np.zeros((12, 1, 7), np.float32)
    pose[:, 0, 0], pose[:, 0, 6] = positions, 1
    command = np.ones((12, 1), np.float32)
    command[8:] = 0
    motion = Motion("", pose, command, None, command)
    # The hand rests from step 2 on, the gripper closes at step 8, the last step is 11.
    assert keyframes(motion) == [2, 8, 11]
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


def test_calibrated_depth_feeds_the_3d_path(folder):
    encoding = dataclasses.replace(ENCODING, use_points=True)
    loader = make(folder, (MANISKILL,), encoding=encoding, image_size=64, crop=0.6, streams=1, threads=0)
    batch = next(loader)
    assert batch.pictures.depth.shape == (4, 1, 64, 64)
    np.testing.assert_allclose(batch.pictures.depth, DEPTH_COUNTS / 1024)
    world_from_camera = np.linalg.inv(camera_from_world())
    camera = jax.tree.map(lambda x: x[:, 0], batch.pictures.camera)
    for intrinsics, pose in zip(camera.intrinsics, camera.world_from_camera, strict=True):
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
        moved = crop_intrinsics(intrinsics, box, (64, 64))
        shown_rows, shown_columns = (crop_resize(x.astype(np.float32), box, (64, 64)) for x in (rows, columns))
        u, v = rng.integers(8, 56, 2)
        ray = np.linalg.inv(moved.astype(np.float64)) @ [u, v, 1]
        before = intrinsics @ ray
        assert before[0] == pytest.approx(shown_columns[v, u], abs=0.1)
        assert before[1] == pytest.approx(shown_rows[v, u], abs=0.1)


def test_light_varies_colours_and_nothing_else():
    picture = np.random.default_rng(0).integers(0, 256, (8, 8, 3), np.uint8)
    same = vary_light(picture, np.random.default_rng(1), 0.0)
    np.testing.assert_allclose(same.astype(int), picture, atol=1)
    varied = vary_light(picture, np.random.default_rng(1), 0.3)
    assert varied.shape == picture.shape
    assert np.abs(varied.astype(int) - picture).mean() > 2
    np.testing.assert_array_equal(varied, vary_light(picture, np.random.default_rng(1), 0.3))


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
    assert not np.any(batch.text.tokens == few.unk_id)


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
