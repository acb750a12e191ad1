import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dsvla_jax.encoding.alignment import AlignmentMode, align_to_patches
from dsvla_jax.encoding.config import EncodingConfig
from dsvla_jax.encoding.encode import CLIP_MEAN, CLIP_STD, build_prompt, encode_text, model_inputs, normalize_image
from dsvla_jax.encoding.farthest_point import farthest_point_sample
from dsvla_jax.encoding.neighbours import k_nearest_neighbours
from dsvla_jax.encoding.point_cloud import cloud_from_depth
from dsvla_jax.encoding.point_tokens import PointTokenizerConfig, positional_encoding, tokenize_points
from dsvla_jax.encoding.prompts import Style, format_answer
from dsvla_jax.encoding.text import WordTokenizer, vocabulary
from dsvla_jax.geometry.cameras import front_camera, unproject
from dsvla_jax.types import Array, Camera, Picture, RobotState, Text

LOW, HIGH = (-1.5, -1.5, 0.76), (1.5, 1.5, 3.0)
SMALL = PointTokenizerConfig(num_points=64, group_sizes=(32, 16, 9), neighbours=5, width=96)


def grid_points(shape: tuple[int, ...], seed: int = 0) -> np.ndarray:
    """Points on a coarse grid: float32 distances are exact, and ties and duplicates abound."""
    return np.random.default_rng(seed).integers(0, 9, (*shape, 3)).astype(np.float32) / 8


def brute_force_fps(points: np.ndarray, valid: np.ndarray, count: int) -> list[int]:
    distance = np.where(valid, np.inf, -1.0)
    chosen = []
    for _ in range(count):
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, ((points - points[chosen[-1]]) ** 2).sum(-1))
    return chosen


@pytest.mark.parametrize("exact", [True, False])
def test_farthest_points_equal_brute_force(exact):
    points = grid_points((3, 90)) if exact else np.random.default_rng(0).normal(size=(3, 90, 3)).astype(np.float32)
    valid = np.asarray(np.random.default_rng(1).random((3, 90)) < 0.6)
    valid[0, 0] = False
    chosen = np.asarray(farthest_point_sample(points, valid, 40))
    for b in range(3):
        assert chosen[b].tolist() == brute_force_fps(points[b], valid[b], 40)
        assert valid[b][chosen[b]].all()
    everything = np.ones(90, bool)
    assert farthest_point_sample(points, None, 40)[1].tolist() == brute_force_fps(points[1], everything, 40)


def test_farthest_points_of_a_large_batch_equal_those_of_its_members():
    points, valid = grid_points((11, 30)), np.asarray(np.random.default_rng(1).random((11, 30)) < 0.8)
    expected = [brute_force_fps(p, v, 12) for p, v in zip(points, valid, strict=True)]
    np.testing.assert_array_equal(farthest_point_sample(points, valid, 12), expected)


def test_farthest_points_repeat_the_first_when_valid_ones_run_out():
    points = np.arange(18, dtype=np.float32).reshape(1, 6, 3)
    valid = np.array([[False, True, False, True, True, False]])
    assert farthest_point_sample(points, valid, 6)[0].tolist() == [1, 4, 3, 1, 1, 1]
    assert farthest_point_sample(points, np.zeros((1, 6), bool), 3)[0].tolist() == [0, 0, 0]


def test_farthest_points_of_farthest_points_are_their_prefix():
    points = np.random.default_rng(2).normal(size=(2, 200, 3)).astype(np.float32)
    ordered = np.take_along_axis(points, np.asarray(farthest_point_sample(points, None, 100))[..., None], 1)
    np.testing.assert_array_equal(farthest_point_sample(ordered, None, 40), np.tile(np.arange(40), (2, 1)))


@pytest.mark.parametrize(("queries", "points", "k"), [(1, 7, 7), (33, 50, 6), (64, 64, 16)])
def test_neighbours_equal_brute_force(queries, points, k):
    cloud = grid_points((points,))
    centers = cloud[:queries]
    distance = ((centers[:, None] - cloud[None]) ** 2).sum(-1)
    expected = np.argsort(distance, axis=1, kind="stable")[:, :k]
    found = np.asarray(k_nearest_neighbours(centers, cloud, k))
    np.testing.assert_array_equal(found, expected)
    assert found.dtype == np.int32
    batched = jax.vmap(lambda q, p: k_nearest_neighbours(q, p, k))(np.stack([centers] * 2), np.stack([cloud] * 2))
    np.testing.assert_array_equal(batched, [expected] * 2)


def test_too_many_neighbours_are_refused():
    with pytest.raises(ValueError, match="k: expected 1 to 4"):
        k_nearest_neighbours(np.zeros((2, 3)), np.zeros((4, 3)), 5)


def test_cloud_keeps_measured_points_of_the_workspace():
    camera = front_camera(16)
    depth = np.random.default_rng(0).uniform(0.8, 2.2, (16, 16)).astype(np.float32)
    depth[0, 0], depth[2, 2], depth[4, 4], depth[6, 6] = 0.0, np.nan, np.inf, -1.0
    points, valid = cloud_from_depth(depth, camera, LOW, HIGH, stride=2)
    assert points.shape == (64, 3)
    assert np.isfinite(points).all()
    world = np.asarray(unproject(np.nan_to_num(depth, posinf=0.0), camera))[::2, ::2].reshape(-1, 3)
    expected = np.array(((world >= LOW) & (world <= HIGH)).all(axis=-1), bool, ndmin=1)
    expected[[0, 9, 18, 27]] = False
    np.testing.assert_array_equal(valid, expected)
    assert 5 < expected.sum() < 60
    np.testing.assert_allclose(np.asarray(points)[expected], world[expected], atol=1e-6)


def test_positional_encoding_is_that_of_point_nn():
    encoding = np.asarray(positional_encoding(jnp.array([0.01, 0.0, 0.0]), 72, 1000.0, 100.0)).reshape(3, 12, 2)
    np.testing.assert_allclose(encoding[0, 0], [0.841471, 0.540302], atol=1e-6)
    np.testing.assert_allclose(encoding[0, 3, 0], np.sin(100 * 0.01 / 1000 ** (3 / 12)), atol=1e-6)
    np.testing.assert_array_equal(encoding[1:, :, 0], 0.0)
    np.testing.assert_allclose(encoding[1:, :, 1], 1.0, atol=1e-6)


def test_positional_encoding_is_accurate_for_large_angles():
    points = np.random.default_rng(0).uniform(-60, 60, (2000, 3)).astype(np.float32)
    encoding = np.asarray(jax.jit(lambda p: positional_encoding(p, 36, 1000.0, 100.0))(points)).reshape(-1, 3, 6, 2)
    scale = (100.0 / 1000.0 ** (np.arange(6) / 6)).astype(np.float32)
    angles = (points[..., None] * scale).astype(np.float64)  # rounded to float32, as any float32 code must
    np.testing.assert_allclose(encoding[..., 0], np.sin(angles), atol=1e-6)
    np.testing.assert_allclose(encoding[..., 1], np.cos(angles), atol=1e-6)


def test_positional_encoding_leaves_channels_beyond_sixes_zero():
    encoding = np.asarray(positional_encoding(jnp.ones((4, 3)), 16, 1000.0, 100.0))
    assert encoding.shape == (4, 16)
    np.testing.assert_array_equal(encoding[:, 12:], 0.0)
    assert (encoding[:, :12] != 0).all()


@pytest.mark.parametrize(("size", "sizes"), [(336, (1344, 880, 576)), (224, (1024, 512, 256))])
def test_group_sizes_end_at_the_number_of_image_patches(size, sizes):
    encoding = EncodingConfig(image_size=size, points=PointTokenizerConfig(group_sizes=sizes))
    assert encoding.num_point_tokens == encoding.grid**2
    assert encoding.points.base_width == 128


def reference_tokens(points: np.ndarray, config: PointTokenizerConfig) -> np.ndarray:
    """The tokenizer written out over explicit (G, K, 2C) tensors, in float64, one neighbourhood at a time."""

    def encode(p: np.ndarray, channels: int) -> np.ndarray:
        out = np.zeros(channels)
        count = channels // 6
        for axis in range(3):
            for k in range(count):
                angle = config.beta * p[axis] / config.alpha ** (k / count)
                out[axis * 2 * count + 2 * k : axis * 2 * count + 2 * k + 2] = np.sin(angle), np.cos(angle)
        return out

    xyz = (points.astype(np.float64) - config.center) / config.half_extent
    features = np.stack([encode(p, config.base_width) for p in xyz])
    for count in config.group_sizes:
        order = [np.argsort(((xyz - c) ** 2).sum(-1), kind="stable")[: config.neighbours] for c in xyz[:count]]
        relative = np.stack([xyz[o] - c for o, c in zip(order, xyz[:count], strict=True)])
        relative /= relative.std(ddof=1) + 1e-5
        pooled = []
        for i in range(count):
            rows = [
                np.concatenate([features[j], features[i]]) + encode(r, 2 * features.shape[1])
                for j, r in zip(order[i], relative[i], strict=True)
            ]
            pooled.append(np.max(rows, axis=0))
        features, xyz = np.stack(pooled), xyz[:count]
    centered = features - features.mean(-1, keepdims=True)
    return centered / (features.std(-1, keepdims=True) + 1e-5) * config.token_rms


def test_tokens_equal_the_written_out_algorithm():
    config = dataclasses.replace(SMALL, token_rms=0.3, beta=10.0)
    points = np.random.default_rng(0).uniform((-0.3, -0.5, 0.6), (0.7, 0.5, 1.6), (64, 3)).astype(np.float32)
    tokens, centers = jax.jit(tokenize_points, static_argnums=1)(points, config)
    np.testing.assert_array_equal(centers, points[:9])
    np.testing.assert_allclose(tokens, reference_tokens(points, config), atol=2e-4)
    np.testing.assert_allclose(np.sqrt(np.mean(np.square(tokens), -1)), 0.3, rtol=1e-3)


def test_batch_mates_do_not_change_a_clouds_tokens():
    clouds = np.random.default_rng(0).uniform(0.0, 1.0, (3, 64, 3)).astype(np.float32)
    tokenize = jax.jit(jax.vmap(lambda p: tokenize_points(p, SMALL)[0]))
    mates = clouds[::-1] * np.array([3.0, 1.0, 0.2], np.float32)[:, None, None]
    np.testing.assert_array_equal(tokenize(clouds)[1], tokenize(mates)[1])


def test_a_cloud_of_one_point_gives_finite_tokens():
    assert np.isfinite(jax.jit(tokenize_points, static_argnums=1)(np.ones((64, 3), np.float32), SMALL)[0]).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"group_sizes": (32, 40)}, "group_sizes"),
        ({"group_sizes": (100, 20)}, r"at most num_points 64"),
        ({"width": 100}, "multiple of"),
        ({"neighbours": 17}, "neighbours: expected at most 16"),
    ],
)
def test_impossible_tokenizers_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(SMALL, **change)


def aligned(points: Array, camera: Camera, size: int, grid: int, mode: AlignmentMode = "aligned") -> Array:
    """The patches of points that one camera, of square pictures, sees."""
    cameras = jax.tree.map(lambda x: x[None], camera)
    return align_to_patches(points, jnp.zeros(len(points), int), cameras, size, size, grid, mode)


@pytest.mark.parametrize("size", [336, 672])
@pytest.mark.parametrize(
    ("point", "pixel"),
    [
        ((0.25, 0.0, 0.752), (168.0, 265.9)),
        ((0.25, 0.3, 0.752), (270.8, 265.9)),
        ((0.25, -0.3, 0.752), (65.2, 265.9)),
        ((-0.1, 0.0, 0.752), (168.0, 206.2)),
        ((0.2785, -0.0082, 1.4719), (164.3, 6.9)),
    ],
)
def test_alignment_golden_pixels(point, pixel, size):
    # The pixels are those of a 336 px image; the same patch must come out whatever the size the picture was taken at.
    column, row = ((np.array(pixel) * size / 336 + 0.5) * 24 / size).astype(int)
    assert aligned(jnp.array([point]), front_camera(size), size, 24).tolist() == [row * 24 + column]


@pytest.mark.parametrize("size", [48, 96])
def test_every_pixel_of_a_depth_map_comes_back_to_its_own_patch(size):
    camera = front_camera(size)
    depth = np.random.default_rng(0).uniform(0.5, 3.0, (size, size)).astype(np.float32)
    patches = aligned(unproject(depth, camera).reshape(-1, 3), camera, size, 6)
    row, column = np.divmod(np.arange(size * size), size)
    np.testing.assert_array_equal(patches, row // (size // 6) * 6 + column // (size // 6))


def test_points_out_of_view_take_a_patch_of_the_border():
    points = jnp.array([[0.25, 5.0, 0.8], [0.25, -5.0, 0.8], [3.0, 0.3, 0.8]])
    row, column = np.divmod(np.asarray(aligned(points, front_camera(96), 96, 6)), 6)
    assert column[0] == 5
    assert column[1] == 0
    assert (row >= 0).all()
    assert (row < 6).all()


def test_index_order_and_unknown_modes():
    camera = front_camera(96)
    assert aligned(jnp.zeros((5, 3)), camera, 96, 6, "index_order").tolist() == [0, 1, 2, 3, 4]
    with pytest.raises(ValueError, match="at most 4 3D tokens"):
        aligned(jnp.zeros((5, 3)), camera, 96, 2, "index_order")
    with pytest.raises(ValueError, match="one of aligned, index_order, got 'virtual_views'"):
        aligned(jnp.zeros((5, 3)), camera, 96, 2, "virtual_views")  # pyright: ignore[reportArgumentType]


CONFIG = EncodingConfig(image_size=32, patch_size=8, points=SMALL, style="compact", max_text_length=40)


def pictures(size: int, batch: int = 2) -> Picture[Array]:
    rng = np.random.default_rng(0)
    return Picture(
        jnp.asarray(rng.integers(0, 256, (batch, 1, size, size, 3)), jnp.uint8),
        jnp.asarray(rng.uniform(0.8, 1.6, (batch, 1, size, size)), jnp.float32),
        jax.tree.map(lambda leaf: jnp.stack([leaf[None]] * batch), front_camera(size)),
    )


def text(batch: int = 2) -> Text[Array]:
    return Text(jnp.zeros((batch, 4), jnp.int32), jnp.ones((batch, 4), bool))


def test_a_picture_and_a_text_become_model_inputs_under_jit():
    inputs = jax.jit(model_inputs, static_argnums=2)(pictures(32), text(), CONFIG)
    assert inputs.images.shape == (2, 1, 32, 32, 3)
    assert inputs.point_tokens.shape == (2, 9, 96)
    assert inputs.point_patches.shape == (2, 9)
    jax.tree.map(np.testing.assert_array_equal, inputs.text, text())
    expected = (np.asarray(pictures(32).rgb, np.float32) / 255 - CLIP_MEAN) / CLIP_STD
    np.testing.assert_allclose(inputs.images, expected, atol=1e-5)
    # The tokens are those of the cloud in farthest-point order, and each carries the patch of its own centre.
    points, valid = cloud_from_depth(pictures(32).depth[1, 0], front_camera(32), LOW, HIGH, stride=2)
    order = brute_force_fps(np.asarray(points), np.asarray(valid), 64)
    tokens, centers = jax.jit(tokenize_points, static_argnums=1)(np.asarray(points)[order], SMALL)
    np.testing.assert_allclose(inputs.point_tokens[1], tokens, atol=1e-3)
    pixel = 2 * np.array(np.divmod(order[:9], 16))
    np.testing.assert_array_equal(inputs.point_patches[1], pixel[0] // 8 * 4 + pixel[1] // 8)
    assert len(centers) == 9


def test_model_inputs_take_other_image_sizes_and_no_points():
    shapes = jax.eval_shape(lambda seen: model_inputs(seen, text(), CONFIG), pictures(48))
    assert shapes.images.shape == (2, 1, 32, 32, 3)
    assert shapes.point_tokens.shape == (2, 9, 96)
    flat = dataclasses.replace(pictures(48), rgb=jnp.full((2, 1, 48, 48, 3), 51, jnp.uint8))
    inputs = model_inputs(flat, text(), dataclasses.replace(CONFIG, use_points=False))
    np.testing.assert_allclose(
        inputs.images, np.broadcast_to((0.2 - np.array(CLIP_MEAN)) / CLIP_STD, (2, 1, 32, 32, 3)), atol=1e-5
    )
    assert inputs.point_tokens.shape == (2, 0, 96)
    assert inputs.point_patches.shape == (2, 0)
    with pytest.raises(ValueError, match=r"at most the 16 points of a depth map of 16 x 16 pixels with .*stride 4"):
        model_inputs(pictures(16), text(), dataclasses.replace(CONFIG, stride=4))
    with pytest.raises(ValueError, match=r"expected a batch of uint8 images .* float32"):
        normalize_image(jnp.zeros((2, 32, 32, 3)), 32)


def test_encode_text_masks_and_prefix():
    tokenizer = WordTokenizer(vocabulary(["lift the lid"]))
    cases: list[tuple[Style, int]] = [("paper", 2), ("compact", 1), ("compact", 2)]
    prompt = ""
    for style, arms in cases:
        config = dataclasses.replace(CONFIG, style=style)
        pose = np.tile(np.array([0.1, 0.2, 1.0, 0, 1, 0, 0], np.float32), (arms, 1))
        robot = RobotState(pose, np.ones(arms))
        prompt = build_prompt(config, "lift the lid", robot, np.full((arms, 3), 0.5))
        answer = format_answer(config.codec.encode(pose, np.zeros(arms)), style)
        both, answer_mask = encode_text(tokenizer, prompt, answer, 300)
        alone, nothing = encode_text(tokenizer, prompt, None, 300)
        tokens, mask = both.tokens, both.mask
        assert tokens[0] == tokenizer.bos_id
        length = alone.mask.sum()
        np.testing.assert_array_equal(tokens[:length], alone.tokens[:length])
        assert not nothing.any()
        assert not answer_mask[:length].any()
        assert answer_mask[length : mask.sum()].all()
        assert tokens[mask][-1] == tokenizer.eos_id
        assert (tokens[~mask] == tokenizer.pad_id).all()
        assert tokenizer.decode(tokens[answer_mask].tolist()) == tokenizer.decode(tokenizer.encode(answer))
    with pytest.raises(ValueError, match="max_text_length 10"):
        encode_text(tokenizer, prompt, None, 10)


def test_prompt_without_keypoints():
    robot = RobotState(np.array([[0.1, 0.2, 1.0, 0, 1, 0, 0]]), np.ones(1))
    assert build_prompt(CONFIG, "lift", robot, np.ones((1, 3))) == (
        "lift state 10 20 100 0 100 0 0 1 near 100 100 100:"
    )
    without = build_prompt(dataclasses.replace(CONFIG, use_keypoints=False), "lift", robot, np.ones((1, 3)))
    assert without == build_prompt(CONFIG, "lift", robot, None) == "lift state 10 20 100 0 100 0 0 1:"


def test_encoding_config_is_hashable():
    assert hash(EncodingConfig()) == hash(EncodingConfig())
    with pytest.raises(ValueError, match="multiple of patch_size 14, got 100"):
        EncodingConfig(image_size=100)
