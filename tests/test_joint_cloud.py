"""The joint cloud of several cameras: each 3D token is aligned with a patch of the camera that sees its centre."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dsvla_jax.encoding.config import EncodingConfig
from dsvla_jax.encoding.encode import cloud_tokens, model_inputs
from dsvla_jax.encoding.point_tokens import PointTokenizerConfig
from dsvla_jax.errors import UserError
from dsvla_jax.types import Array, Camera, Picture, Text

HEIGHT, WIDTH, GRID, STRIDE = 24, 36, 6, 2
LOW, HIGH = (-0.8, -0.8, 0.2), (0.8, 0.8, 1.4)
CONFIG = EncodingConfig(
    image_size=48,
    patch_size=48 // GRID,
    points=PointTokenizerConfig(num_points=64, group_sizes=(48,), neighbours=2, width=12),
    stride=STRIDE,
    workspace_low=LOW,
    workspace_high=HIGH,
    max_text_length=8,
)
tokens_of = jax.jit(cloud_tokens, static_argnums=1)


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    matrix, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return matrix * np.sign(np.linalg.det(matrix))


def random_camera(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Intrinsics, of either sign and with skew, and a pose that looks from about 1 m at the middle of the workspace."""
    focal = rng.uniform(0.8, 1.6, 2) * WIDTH * rng.choice([-1, 1], 2)
    centre = np.array([WIDTH, HEIGHT]) * rng.uniform(0.4, 0.6, 2)
    intrinsics = np.array([[focal[0], rng.uniform(-2, 2), centre[0]], [0, focal[1], centre[1]], [0, 0, 1]])
    pose = np.eye(4)
    pose[:3, :3] = random_rotation(rng)
    pose[:3, 3] = [0, 0, 0.8] - pose[:3, 2] * rng.uniform(0.8, 1.2)
    return intrinsics, pose


def random_pictures(rng: np.random.Generator, batch: int, cameras: int) -> Picture[Array]:
    """Scenes of nothing: every pixel has a random depth of about 1 m, or no reading."""
    depth = rng.uniform(0.5, 1.5, (batch, cameras, HEIGHT, WIDTH)) * (rng.random((batch, cameras, HEIGHT, WIDTH)) < 0.8)
    looks = [[random_camera(rng) for _ in range(cameras)] for _ in range(batch)]
    intrinsics, poses = (np.array([[one[i] for one in row] for row in looks]) for i in range(2))
    rgb = rng.integers(0, 256, (batch, cameras, HEIGHT, WIDTH, 3), np.uint8)
    arrays = (jnp.asarray(x, jnp.float32) for x in (depth, intrinsics, poses))
    depth, intrinsics, poses = arrays
    return Picture(jnp.asarray(rgb), depth, Camera(intrinsics, poses))


def written_out(depth: np.ndarray, intrinsics: np.ndarray, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centres (G, 3) and patches (G,) of one example, in NumPy and double precision.

    No point is projected: a point's patch is that of the pixel that it was seen at.
    """
    points, patches = [], []
    for camera, (one, matrix, pose) in enumerate(zip(depth, intrinsics, poses, strict=True)):
        for v in range(0, HEIGHT, STRIDE):
            for u in range(0, WIDTH, STRIDE):
                seen = np.linalg.solve(matrix, [u, v, 1]) * one[v, u]
                point = pose[:3, :3] @ seen + pose[:3, 3]
                if one[v, u] > 0 and np.all(point >= LOW) and np.all(point <= HIGH):
                    points.append(point)
                    patches.append(camera * GRID**2 + v * GRID // HEIGHT * GRID + u * GRID // WIDTH)
    cloud, chosen = np.array(points), [0]
    distance = np.full(len(cloud), np.inf)
    while len(chosen) < CONFIG.num_point_tokens:
        distance = np.minimum(distance, ((cloud - cloud[chosen[-1]]) ** 2).sum(-1))
        chosen.append(int(np.argmax(distance)))
    return cloud[chosen], np.array(patches)[chosen]


@pytest.mark.parametrize("cameras", [1, 2, 3, 4])
def test_each_token_is_aligned_with_a_patch_of_the_camera_that_sees_its_centre(cameras):
    pictures = random_pictures(np.random.default_rng(cameras), 8, cameras)
    _, centers, patches = map(np.asarray, tokens_of(pictures, CONFIG))
    used = set()
    for i in range(len(centers)):
        arrays = (pictures.depth[i], pictures.camera.intrinsics[i], pictures.camera.world_from_camera[i])
        expected_centers, expected_patches = written_out(*(np.asarray(x, np.float64) for x in arrays))
        np.testing.assert_allclose(centers[i], expected_centers, atol=1e-5)
        np.testing.assert_array_equal(patches[i], expected_patches)
        used |= set((patches[i] // GRID**2).tolist())
    assert used == set(range(cameras))


def test_the_order_of_cameras_changes_numbers_of_patches_only():
    """Seen with the cameras exchanged, the same points are found; the first point of all may be another one."""
    pictures = random_pictures(np.random.default_rng(9), 2, 2)
    exchanged = jax.tree.map(lambda x: x[:, ::-1], pictures)
    everything = dataclasses.replace(
        CONFIG, points=dataclasses.replace(CONFIG.points, num_points=300, group_sizes=(300,))
    )
    (_, centers, patches), (_, other_centers, other_patches) = (
        map(np.asarray, tokens_of(x, everything)) for x in (pictures, exchanged)
    )
    for i in range(2):
        found = {tuple(c): p for c, p in zip(centers[i].tolist(), patches[i].tolist(), strict=True)}
        others = {tuple(c): p for c, p in zip(other_centers[i].tolist(), other_patches[i].tolist(), strict=True)}
        shared = found.keys() & others.keys()
        assert len(shared) > 100
        assert all(others[point] == (found[point] + GRID**2) % (2 * GRID**2) for point in shared)


def test_index_order_runs_over_the_patches_of_all_cameras():
    ordered = dataclasses.replace(CONFIG, alignment="index_order")
    with pytest.raises(UserError, match=r"group_sizes: expected at most 36 tokens .*index_order.*got 48"):
        ordered.require_patches(1)
    ordered.require_patches(2)
    _, _, patches = tokens_of(random_pictures(np.random.default_rng(0), 2, 2), ordered)
    np.testing.assert_array_equal(patches, np.tile(np.arange(48), (2, 1)))


def test_images_are_those_of_each_camera():
    pictures = random_pictures(np.random.default_rng(1), 2, 3)
    text = Text(jnp.zeros((2, 4), jnp.int32), jnp.ones((2, 4), bool))
    config = dataclasses.replace(CONFIG, use_points=False)
    encode = jax.jit(model_inputs, static_argnums=2)
    images = encode(pictures, text, config).images
    assert images.shape == (2, 3, 48, 48, 3)
    for c in range(3):
        alone = encode(jax.tree.map(lambda x, c=c: x[:, c : c + 1], pictures), text, config).images
        np.testing.assert_allclose(images[:, c], alone[:, 0], atol=1e-6)
