"""Keypoints from pictures: phrases of instructions, masks to world points, and the chain of Grounding DINO and SAM."""

import json

import numpy as np
import pytest

from data_pipelines.find_keypoints import find as find_keypoints_of
from data_pipelines.records import Episode, encode_depth, encode_rgb, pack_episode, unpack_episode
from dsvla_jax.errors import UserError
from dsvla_jax.geometry.cameras import front_camera, unproject
from dsvla_jax.perception.grounding import GroundedSegmenter
from dsvla_jax.perception.keypoints import (
    ONE_END,
    OTHER_END,
    KeypointsNotFound,
    KeypointTracker,
    Sighting,
    draw_sightings,
    find_keypoints,
    keypoint_pixel,
    locate,
)
from dsvla_jax.perception.phrases import ObjectPhrases, load_table, phrases_for
from dsvla_jax.perception.simulator import suite_phrases
from dsvla_jax.sim.environment import Environment
from dsvla_jax.sim.objects import object_geoms, object_masks
from dsvla_jax.sim.seeds import episode_keys
from dsvla_jax.sim.tasks import TASKS

SIZE = 64
CAMERA = front_camera(SIZE)


def disc(u: float, v: float, radius: float) -> np.ndarray:
    rows, columns = np.mgrid[:SIZE, :SIZE]
    return (columns - u) ** 2 + (rows - v) ** 2 <= radius**2


def everywhere() -> np.ndarray:
    return np.ones((SIZE, SIZE), bool)


def segmenter_of(masks: dict[str, np.ndarray]):
    """A detector that knows these masks and nothing else."""
    return lambda rgb, phrases: [
        Sighting(phrase, masks[phrase]) if phrase in masks else Sighting(phrase, score=0.1, problem="no box")
        for phrase in phrases
    ]


@pytest.mark.parametrize("name", TASKS)
def test_every_instruction_of_the_suite_has_the_phrases_of_its_task(name):
    task, table = TASKS[name], suite_phrases()
    for variation in range(task.variations):
        for way in range(len(task.instructions)):
            assert phrases_for(task.say(variation, way), table) == task.phrases(task.words(variation))
    without_colour = task.phrases({"colour": ""})
    assert phrases_for(name, table) == tuple(tuple(phrase.strip() for phrase in arm) for arm in without_colour)


def test_phrases_of_other_instructions_come_from_a_file(tmp_path):
    with pytest.raises(UserError, match=r"no object phrases for the instruction 'fold the shirt'.*perception\.md"):
        phrases_for("fold the shirt", suite_phrases())
    file = tmp_path / "phrases.json"
    file.write_text(json.dumps({r"\bshirt\b": ["left sleeve", "right sleeve"], "cup": [["cup"], ["saucer"]]}))
    table = (*load_table(file), *suite_phrases())
    assert phrases_for("Fold the shirt", table) == (("left sleeve", "right sleeve"),)
    assert phrases_for("lift the cup", table) == (("cup",), ("saucer",))
    assert phrases_for("turn on the light", table) == TASKS["lamp_on"].phrases({})
    for wrong in ("[]", "{", '{"(": ["x"]}', '{"x": []}', '{"x": "y"}', '{"x": [[]]}'):
        file.write_text(wrong)
        with pytest.raises(UserError, match=r"phrases\.json: expected a JSON object"):
            load_table(file)


def test_the_keypoint_of_a_disc_is_its_centre():
    assert keypoint_pixel(disc(20, 31, 6), everywhere()) == (20, 31)


def test_a_centre_beside_the_object_is_moved_onto_it_and_away_from_its_edge():
    ring = disc(32, 32, 16) & ~disc(32, 32, 9)
    u, v = keypoint_pixel(ring, everywhere())  # type: ignore[misc]
    assert ring[v - 1 : v + 2, u - 1 : u + 2].all()
    assert np.hypot(u - 32, v - 32) < 13
    thin = np.zeros((SIZE, SIZE), bool)
    thin[10:30, 40] = True
    assert keypoint_pixel(thin, everywhere()) == (40, 19)


def test_pixels_without_depth_are_avoided():
    mask, readable = disc(30, 30, 10), everywhere()
    readable[28:33, 28:33] = False
    u, v = keypoint_pixel(mask, readable)  # type: ignore[misc]
    assert readable[v, u]
    assert mask[v, u]
    assert np.hypot(u - 30, v - 30) < 4


def test_ends_of_a_long_object():
    rope = np.zeros((SIZE, SIZE), bool)
    for i in range(40):
        rope[20 + i // 4 : 25 + i // 4, 10 + i] = True
    left, right = (keypoint_pixel(rope, everywhere(), end) for end in (ONE_END, OTHER_END))
    assert left
    assert right
    assert np.hypot(left[0] - 10, left[1] - 22) < 4
    assert np.hypot(right[0] - 49, right[1] - 31) < 4


def test_the_depth_is_the_objects_own_and_not_that_behind_it():
    depth = np.full((SIZE, SIZE), 1.5, np.float32)
    thin = np.zeros((SIZE, SIZE), bool)
    thin[20:40, 30:32] = True
    depth[thin] = 1.0
    depth[25, 30] = 0.0
    found = locate(Sighting("pole", thin), depth, CAMERA)
    u, v = found.pixel  # type: ignore[misc]
    assert found.point is not None
    np.testing.assert_allclose(found.point, np.asarray(unproject(np.full_like(depth, 1.0), CAMERA))[v, u], atol=1e-5)


def test_what_is_not_found_is_said_for_each_phrase():
    masks = {"cup": disc(20, 20, 5), "plate": np.zeros((SIZE, SIZE), bool), "mirror": disc(50, 50, 5)}
    depth = np.ones((SIZE, SIZE), np.float32)
    depth[masks["mirror"]] = np.nan
    rgb = np.zeros((SIZE, SIZE, 3), np.uint8)
    segment = segmenter_of(masks)
    points, (sighting,) = find_keypoints(segment, rgb, depth, CAMERA, [["cup"], ["cup"]])
    assert points.shape == (2, 1, 3)
    np.testing.assert_array_equal(points[0, 0], sighting.point)
    with pytest.raises(KeypointsNotFound) as caught:
        find_keypoints(segment, rgb, depth, CAMERA, [["cup", "plate", "mirror", "fork"]])
    assert str(caught.value) == (
        "keypoints not found: 'plate': its mask is empty; 'mirror': there is no depth reading on it; 'fork': no box"
    )
    assert [sighting.point is None for sighting in caught.value.sightings] == [False, True, True, True]
    drawn = draw_sightings(rgb, caught.value.sightings)
    assert drawn.shape == rgb.shape
    assert (drawn != rgb).any()


def test_arms_with_fewer_objects_repeat_their_last():
    masks = {"cup": disc(20, 20, 5), "plate": disc(40, 40, 5)}
    rgb, depth = np.zeros((SIZE, SIZE, 3), np.uint8), np.ones((SIZE, SIZE), np.float32)
    points, _ = find_keypoints(segmenter_of(masks), rgb, depth, CAMERA, [["cup", "plate"], ["plate"]])
    np.testing.assert_array_equal(points[1], [points[0, 1], points[0, 1]])


@pytest.mark.parametrize("refresh", [False, True])
def test_keypoints_are_the_first_frames_or_refreshed_while_they_are_seen(refresh):
    masks = {"cup": disc(20, 20, 5)}
    rgb, depth = np.zeros((SIZE, SIZE, 3), np.uint8), np.ones((SIZE, SIZE), np.float32)
    tracker = KeypointTracker(lambda rgb, phrases: segmenter_of(masks)(rgb, phrases), refresh=refresh)
    first = tracker.keypoints(rgb, depth, CAMERA, [["cup"]])
    masks["cup"] = disc(40, 20, 5)
    second = tracker.keypoints(rgb, depth, CAMERA, [["cup"]])
    assert np.array_equal(second, first) == (not refresh)
    masks.clear()  # behind the arm
    np.testing.assert_array_equal(tracker.keypoints(rgb, depth, CAMERA, [["cup"]]), second)
    tracker.reset()
    with pytest.raises(KeypointsNotFound, match="'cup': no box"):
        tracker.keypoints(rgb, depth, CAMERA, [["cup"]])


def test_the_simulators_masks_are_of_the_objects_that_are_named():
    """The button of the lamp, of which the simulator knows where it is."""
    environment = Environment("lamp_on", image_size=128)
    state = environment.reset(episode_keys(0, "validation", "lamp_on", 0, 2))
    seen = environment.render(state)
    masks = object_masks(environment, state, seen)
    assert masks.shape == (2, 1, 128, 128)
    for i, top in enumerate(np.asarray(environment.keypoints(state))[:, 0, 0]):
        camera = front_camera(128)
        found = locate(Sighting("button", masks[i, 0]), np.asarray(seen.depth)[i], camera)
        # The keypoint is the button's top; its dome, 24 mm in radius, is seen from the side.
        assert np.linalg.norm(found.point - top) < 0.024
        assert np.all(np.asarray(seen.rgb)[i][masks[i, 0]][:, 1] > np.asarray(seen.rgb)[i][masks[i, 0]][:, 0])


@pytest.mark.parametrize("name", TASKS)
def test_every_named_object_has_geoms_of_its_own(name):
    environment = Environment(name, image_size=32)
    for variation in range(min(3, TASKS[name].variations)):
        groups = object_geoms(environment, variation)
        assert all(groups)
        assert len({geom for group in groups for geom in group}) == sum(map(len, groups))


def test_recorded_episodes_get_the_keypoints_of_their_first_picture():
    """Two pictures: the cup is where it is in the first, and the arm reaches it in the second."""
    depth, far = np.ones((SIZE, SIZE), np.float32), np.full((1, 7), 0.1, np.float32)
    cup = np.asarray(unproject(depth, CAMERA))[20, 20]
    pose = np.stack([far, far])
    pose[1, 0, :3] = cup
    pictures = [encode_rgb(np.full((SIZE, SIZE, 3), value, np.uint8)) for value in (0, 9)]
    episode = Episode(
        task="cups",
        instruction="put the cup on the plate",
        seed=0,
        rgb_png=tuple(pictures),
        depth_png=(encode_depth(depth),) * 2,
        intrinsics=np.stack([CAMERA.intrinsics[None]] * 2),
        world_from_camera=np.stack([CAMERA.world_from_camera[None]] * 2),
        pose=pose,
        gripper_open=np.ones((2, 1), np.float32),
        target_pose=pose,
        target_gripper=np.ones((2, 1), np.float32),
        keypoints=np.zeros((1, 1, 3), np.float32),
        active_keypoint=np.zeros((2, 1, 3), np.float32),
    )
    segment = segmenter_of({"cup": disc(20, 20, 3), "plate": disc(40, 40, 5)})
    table = (ObjectPhrases("cups", "cup", (("cup", "plate"),)),)
    relabelled, sightings = find_keypoints_of(episode, segment, table)
    assert [sighting.pixel for sighting in sightings] == [(20, 20), (40, 40)]
    np.testing.assert_allclose(relabelled.keypoints[0, 0], cup, atol=1e-4)
    np.testing.assert_array_equal(relabelled.active_keypoint[:, 0], relabelled.keypoints[0])
    unpack_episode(pack_episode(relabelled), "here")


@pytest.fixture(scope="module")
def tiny_models(tmp_path_factory):
    """Grounding DINO and SAM with random weights, as folders that `from_pretrained` reads."""
    torch, transformers = pytest.importorskip("torch"), pytest.importorskip("transformers")
    pytest.importorskip("torchvision")
    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("models")
    words = ["[PAD]", "[UNK]", "[CLS]", "[SEP]", "[MASK]", ".", "red", "box", "green", "light", "rope"]
    (folder / "vocab.txt").write_text("\n".join(words))
    backbone = transformers.SwinConfig(
        image_size=64,
        embed_dim=8,
        depths=[1, 1, 1, 1],
        num_heads=[1, 1, 2, 2],
        window_size=2,
        out_indices=[2, 3, 4],
    )
    detector = transformers.GroundingDinoConfig(
        backbone_config=backbone,
        text_config=transformers.BertConfig(
            vocab_size=len(words),
            hidden_size=16,
            num_hidden_layers=1,
            num_attention_heads=2,
            intermediate_size=16,
            max_position_embeddings=64,
        ),
        d_model=32,
        encoder_layers=1,
        decoder_layers=2,
        encoder_ffn_dim=16,
        decoder_ffn_dim=16,
        encoder_attention_heads=2,
        decoder_attention_heads=2,
        num_queries=12,
        encoder_n_points=2,
        decoder_n_points=2,
    )
    transformers.GroundingDinoForObjectDetection(detector).save_pretrained(folder / "detector")
    transformers.GroundingDinoProcessor(
        transformers.GroundingDinoImageProcessor(size={"shortest_edge": 64, "longest_edge": 96}),
        transformers.BertTokenizer(str(folder / "vocab.txt")),
    ).save_pretrained(folder / "detector")
    small = {"hidden_size": 16, "mlp_dim": 16, "num_hidden_layers": 1, "num_attention_heads": 2}
    picture = {"image_size": 64, "patch_size": 8}
    segmenter = transformers.SamConfig(
        vision_config={
            **small,
            **picture,
            "output_channels": 16,
            "window_size": 2,
            "global_attn_indexes": [0],
            "num_pos_feats": 8,
        },
        prompt_encoder_config={"hidden_size": 16, **picture, "mask_input_channels": 4},
        mask_decoder_config={**small, "iou_head_hidden_dim": 16},
    )
    transformers.SamModel(segmenter).save_pretrained(folder / "segmenter")
    transformers.SamProcessor(
        transformers.SamImageProcessor(
            size={"longest_edge": 64},
            pad_size={"height": 64, "width": 64},
            mask_size={"longest_edge": 32},
            mask_pad_size={"height": 32, "width": 32},
        )
    ).save_pretrained(folder / "segmenter")
    return str(folder / "detector"), str(folder / "segmenter")


PICTURE = np.random.default_rng(0).integers(0, 256, (48, 72, 3), dtype=np.uint8)


def test_boxes_are_those_of_the_detector_in_pixels(tiny_models):
    """Against the model's own outputs, with the phrase written as it was trained with."""
    torch, transformers = pytest.importorskip("torch"), pytest.importorskip("transformers")
    (sighting,) = GroundedSegmenter.from_pretrained(*tiny_models, box_threshold=0.0)(PICTURE, ["Red box"])
    processor = transformers.GroundingDinoProcessor.from_pretrained(tiny_models[0])
    detector = transformers.GroundingDinoForObjectDetection.from_pretrained(tiny_models[0]).eval()
    inputs = processor(images=PICTURE, text="red box.", return_tensors="pt")
    assert inputs["input_ids"].tolist() == [[2, 6, 7, 5, 3]]
    with torch.inference_mode():
        outputs = detector(**inputs)
    scores = outputs.logits.sigmoid()[0].amax(dim=-1)
    x, y, width, height = (outputs.pred_boxes[0, int(scores.argmax())] * torch.tensor([72, 48, 72, 48])).tolist()
    expected = [x - width / 2, y - height / 2, x + width / 2, y + height / 2]
    assert sighting.box is not None
    np.testing.assert_allclose(sighting.box, np.clip(expected, 0, [71, 47, 71, 47]), atol=1e-3)
    assert sighting.score == pytest.approx(float(scores.max()), abs=1e-6)


def test_masks_have_the_pictures_shape_and_follow_the_box(tiny_models):
    segment = GroundedSegmenter.from_pretrained(*tiny_models, box_threshold=0.0)
    sightings = segment(PICTURE, ["red box", "green light", f"rope{ONE_END}", f"rope{OTHER_END}"])
    assert [sighting.phrase for sighting in sightings][2:] == [f"rope{ONE_END}", f"rope{OTHER_END}"]
    assert sightings[2].box == sightings[3].box
    for sighting in sightings:
        assert sighting.mask is not None
        assert (sighting.mask.shape, sighting.mask.dtype) == ((48, 72), np.dtype(bool))
    whole, part = (segment._segment(PICTURE, box) for box in ((0.0, 0.0, 71.0, 47.0), (5.0, 5.0, 12.0, 11.0)))
    assert (whole != part).any()


def test_a_phrase_that_scores_too_little_is_not_found(tiny_models):
    (sighting,) = GroundedSegmenter.from_pretrained(*tiny_models, box_threshold=1.01)(PICTURE, ["red box"])
    assert sighting.mask is None
    assert sighting.problem == f"the best box scores {sighting.score:.2f}, less than 1.01"


def test_models_that_are_not_there_are_an_error_of_the_users(tmp_path):
    pytest.importorskip("torch")
    pytest.importorskip("torchvision")
    with pytest.raises(UserError, match=r"cannot load .*give folders"):
        GroundedSegmenter.from_pretrained(str(tmp_path), str(tmp_path))
