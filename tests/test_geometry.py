import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dsvla_jax.geometry.cameras import front_camera, make_camera, project, unproject
from dsvla_jax.geometry.rotations import (
    DOWN,
    canonical_quaternion,
    matrix_to_quaternion,
    quaternion_conjugate,
    quaternion_from_axis_angle,
    quaternion_from_wxyz,
    quaternion_multiply,
    quaternion_rotate,
    quaternion_slerp,
    quaternion_to_matrix,
    quaternion_to_rotation_vector,
    quaternion_to_wxyz,
    rotation_distance,
    rotation_vector_to_quaternion,
)


def random_quaternions(count: int, seed: int = 0) -> np.ndarray:
    q = np.random.default_rng(seed).normal(size=(count, 4)).astype(np.float32)
    return q / np.linalg.norm(q, axis=-1, keepdims=True)


@pytest.mark.parametrize(
    ("size", "focal"), [(128, -175.8386), (224, -307.7175), (256, -351.6771), (336, -461.5762), (672, -923.1524)]
)
def test_front_camera_has_rlbench_focal_lengths(size, focal):
    k = np.asarray(front_camera(size).intrinsics)
    np.testing.assert_allclose([k[0, 0], k[1, 1]], focal, atol=2e-4)
    np.testing.assert_allclose([k[0, 2], k[1, 2]], size / 2)


@pytest.mark.parametrize(
    ("point", "pixel", "depth"),
    [
        ((0.25, 0.0, 0.752), (168.0, 265.9), 1.347),
        ((0.25, 0.3, 0.752), (270.8, 265.9), 1.347),
        ((0.25, -0.3, 0.752), (65.2, 265.9), 1.347),
        ((-0.1, 0.0, 0.752), (168.0, 206.2), None),
        ((0.2785, -0.0082, 1.4719), (164.3, 6.9), None),
        ((0.55, 0.0, 0.752), (168.0, 345.0), None),
    ],
)
def test_front_camera_golden_pixels(point, pixel, depth):
    uv, z = project(jnp.array(point), front_camera(336))
    np.testing.assert_allclose(uv, pixel, atol=0.5 if pixel[1] == 345.0 else 0.06)
    if depth is not None:
        np.testing.assert_allclose(z, depth, atol=5e-4)


def test_project_undoes_unproject_on_integer_pixels():
    height, width = 24, 40
    camera = make_camera(front_camera(40).world_from_camera, np.deg2rad(40.0), height, width)
    depth = np.random.default_rng(0).uniform(0.3, 3.0, (height, width)).astype(np.float32)
    uv, z = project(unproject(jnp.asarray(depth), camera), camera)
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    np.testing.assert_allclose(uv, np.stack([u, v], -1), atol=1e-3)
    np.testing.assert_allclose(z, depth, rtol=1e-5)


def test_unproject_follows_the_pyrep_formula():
    camera = front_camera(16)
    depth = np.linspace(0.5, 2.0, 256, dtype=np.float32).reshape(16, 16)
    k, pose = np.asarray(camera.intrinsics, np.float64), np.asarray(camera.world_from_camera, np.float64)
    u, v = 5, 11
    expected = pose[:3, :3] @ (np.linalg.inv(k) @ np.array([u, v, 1.0]) * depth[v, u]) + pose[:3, 3]
    np.testing.assert_allclose(unproject(jnp.asarray(depth), camera)[v, u], expected, atol=1e-5)


def test_points_in_and_behind_the_lens_stay_finite():
    camera = front_camera(32)
    points = jnp.stack([camera.world_from_camera[:3, 3], jnp.array([3.0, 0.0, 2.5])])
    uv, z = project(points, camera)
    assert np.isfinite(uv).all()
    assert (np.asarray(z) <= 0).all()


def test_make_camera_names_a_wrong_pose_shape():
    with pytest.raises(ValueError, match=r"world_from_camera.*\(3, 4\)"):
        make_camera(jnp.zeros((3, 4)), 0.7, 8, 8)


def test_rotation_by_quaternion_and_by_matrix_agree_and_compose():
    a, b = random_quaternions(50, 1), random_quaternions(50, 2)
    v = np.random.default_rng(3).normal(size=(50, 3)).astype(np.float32)
    by_matrix = np.einsum("nij,njk,nk->ni", quaternion_to_matrix(a), quaternion_to_matrix(b), v)
    np.testing.assert_allclose(quaternion_rotate(quaternion_multiply(a, b), v), by_matrix, atol=2e-6)
    np.testing.assert_allclose(quaternion_rotate(quaternion_conjugate(a), quaternion_rotate(a, v)), v, atol=2e-6)


def test_matrix_to_quaternion_inverts_including_half_turns():
    half_turns = np.array([[1, 0, 0, 0], DOWN, [0, 0, 1, 0], [0, 0, 0, 1], [0.6, 0.8, 0, 0]], np.float32)
    q = np.concatenate([canonical_quaternion(random_quaternions(200)), half_turns])
    np.testing.assert_allclose(matrix_to_quaternion(quaternion_to_matrix(q)), q, atol=2e-6)


def test_down_points_the_gripper_at_the_table():
    np.testing.assert_allclose(quaternion_rotate(DOWN, jnp.array([0.0, 0.0, 1.0])), [0, 0, -1], atol=1e-7)


def test_axis_angle_and_distance():
    q = quaternion_from_axis_angle(jnp.array([0.0, 0.0, 2.0]), jnp.array(np.pi / 2))
    np.testing.assert_allclose(quaternion_rotate(q, jnp.array([1.0, 0.0, 0.0])), [0, 1, 0], atol=1e-6)
    turns = jnp.array([0.0, 1e-4, 0.3, 3.1])
    q = quaternion_from_axis_angle(jnp.array([1.0, 2.0, -1.0]), turns)
    np.testing.assert_allclose(rotation_distance(q, jnp.array([0.0, 0, 0, 1])), turns, atol=1e-6)
    np.testing.assert_allclose(rotation_distance(q, -q), 0.0, atol=1e-6)


def test_wxyz_order():
    np.testing.assert_array_equal(quaternion_from_wxyz(jnp.array([1.0, 2, 3, 4])), [2, 3, 4, 1])
    np.testing.assert_array_equal(quaternion_to_wxyz(jnp.array([1.0, 2, 3, 4])), [4, 1, 2, 3])


def test_canonical_quaternion():
    q = random_quaternions(100)
    canonical = np.asarray(canonical_quaternion(q))
    assert (canonical[:, 3] >= 0).all()
    np.testing.assert_array_equal(canonical, canonical_quaternion(-q))
    np.testing.assert_array_equal(canonical_quaternion(-DOWN), DOWN)
    noisy = jnp.array([-0.003, -1.0, 0.002, 0.004])
    np.testing.assert_array_equal(canonical_quaternion(noisy, tolerance=0.005), -noisy)


def test_slerp_takes_the_short_way_at_constant_speed():
    a, b = random_quaternions(30, 4), random_quaternions(30, 5)
    full = rotation_distance(a, b)
    for t in (0.0, 0.25, 0.5, 1.0):
        middle = quaternion_slerp(a, b, jnp.full(30, t))
        np.testing.assert_allclose(rotation_distance(a, middle), t * full, atol=3e-4)
        np.testing.assert_allclose(rotation_distance(middle, b), (1 - t) * full, atol=3e-4)
    np.testing.assert_allclose(quaternion_slerp(a, a, jnp.full(30, 0.3)), a, atol=1e-6)
    gradient = jax.grad(lambda t: quaternion_slerp(jnp.asarray(a[0]), jnp.asarray(a[0]), t).sum())(0.5)
    assert np.isfinite(gradient)


@pytest.mark.parametrize("library", [np, jnp])
def test_rotation_vectors_are_scipys_in_the_precision_of_the_library(library):
    quaternions = np.random.default_rng(3).normal(size=(50, 4))
    quaternions /= np.linalg.norm(quaternions, axis=-1, keepdims=True)
    quaternions = np.concatenate([quaternions, [[0, 0, 0, 1], [1, 0, 0, 0], [1e-9, 0, 0, 1], [0, 0, 0, -1]]])
    expected, tolerance = Rotation.from_quat(quaternions).as_rotvec(), 1e-14 if library is np else 2e-6
    vectors = quaternion_to_rotation_vector(library.asarray(quaternions))
    np.testing.assert_allclose(vectors, expected, atol=tolerance)
    again = np.asarray(rotation_vector_to_quaternion(vectors))
    np.testing.assert_allclose(again * np.where(quaternions[:, 3:] < 0, -1, 1), quaternions, atol=tolerance)
