"""Random variations of a frame keep it true: what moves, moves along with its camera, and the rest stays."""

import copy
from dataclasses import fields, replace

import jax
import numpy as np
import pytest

from data_pipelines import augment
from data_pipelines.records import decode_frame
from dsvla_jax.types import join_cameras, named_arrays, split_cameras
from tests.random_data import random_episode


def arrays_of(frame):
    """All fields of a frame, and those of their fields, by name."""
    return named_arrays({field.name: jax.tree.map(np.asarray, getattr(frame, field.name)) for field in fields(frame)})


def project(points, frame):
    """Pixels of world points, written out with homogeneous matrices."""
    camera = np.linalg.inv(frame.pictures.camera.world_from_camera[0].astype(np.float64)) @ np.append(points, 1.0)
    pixel = frame.pictures.camera.intrinsics[0].astype(np.float64) @ camera[:3]
    return pixel[:2] / pixel[2]


def test_shift_world_keeps_every_pixel():
    rng = np.random.default_rng(0)
    frame = decode_frame(random_episode(0), 1)
    offset = augment.random_offset(rng, (0.3, 0.3, 0.1))
    shifted = augment.shift_world(frame, offset)
    for field in ("robot.pose", "target.pose", "keypoint"):
        moved, old = arrays_of(shifted)[field], arrays_of(frame)[field]
        np.testing.assert_allclose(project(moved[0, :3], shifted), project(old[0, :3], frame), atol=1e-3)
        np.testing.assert_allclose(moved[0, :3] - old[0, :3], offset, atol=1e-6)
    np.testing.assert_array_equal(shifted.robot.pose[:, 3:], frame.robot.pose[:, 3:])
    assert shifted.pictures.rgb is frame.pictures.rgb


def smooth_frame(size=64):
    """A table 1 m and more before the camera, whose colour is its place in the picture."""
    frame = decode_frame(random_episode(0, size=size), 0)
    v, u = np.mgrid[:size, :size]
    depth = (1 + 0.002 * u + 0.004 * v).astype(np.float32)
    rgb = np.stack([3 * u, 3 * v, np.full_like(u, 90)], -1).astype(np.uint8)
    return replace(frame, pictures=replace(frame.pictures, rgb=rgb[None], depth=depth[None]))


def world_points(frame):
    v, u = np.mgrid[: frame.pictures.depth.shape[1], : frame.pictures.depth.shape[2]]
    rays = (
        np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(frame.pictures.camera.intrinsics[0].astype(np.float64)).T
    )
    points = rays * frame.pictures.depth[0, ..., None]
    return (
        points @ frame.pictures.camera.world_from_camera[0][:3, :3].T
        + frame.pictures.camera.world_from_camera[0][:3, 3]
    )


def test_a_crop_keeps_every_point_at_its_place():
    frame = smooth_frame()
    for seed in range(20):
        cropped = augment.random_crop(frame, np.random.default_rng(seed), 0.4)
        assert cropped.pictures.depth.shape == (1, 64, 64)
        for name in ("pictures.camera.world_from_camera", "robot.pose", "target.pose", "keypoint"):
            np.testing.assert_array_equal(arrays_of(cropped)[name], arrays_of(frame)[name])
        # Where the original camera sees each point of the cropped cloud, its picture has the same colour and depth.
        for v in range(0, 64, 7):
            for u in range(0, 64, 7):
                x, y = project(world_points(cropped)[v, u], frame)
                np.testing.assert_allclose(cropped.pictures.rgb[0, v, u, :2], [3 * x, 3 * y], atol=3 * 0.5 + 0.5)
                assert abs(cropped.pictures.depth[0, v, u] - (1 + 0.002 * x + 0.004 * y)) < 0.5 * 0.006 + 1e-5
    assert (
        augment.random_crop(frame, np.random.default_rng(0), 1.0).pictures.camera.intrinsics.tolist()
        == frame.pictures.camera.intrinsics.tolist()
    )


def test_a_window_of_the_picture_is_that_window():
    frame = smooth_frame()
    (whole,) = split_cameras(frame.pictures)
    cropped = augment.crop(whole, 10, 20, 32, 32)
    twice = whole.depth[10:42, 20:52].repeat(2, axis=0).repeat(2, axis=1)
    np.testing.assert_array_equal(cropped.depth, twice)
    # Linear colours: the mean of the four pixels that stand for one is that pixel, but at the border.
    means = cropped.rgb.reshape(32, 2, 32, 2, 3).astype(float).mean(axis=(1, 3))
    np.testing.assert_allclose(means[1:-1, 1:-1], whole.rgb[11:41, 21:51], atol=0.5)
    middle = world_points(replace(frame, pictures=join_cameras([cropped]))).reshape(32, 2, 32, 2, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(middle, world_points(frame)[10:42, 20:52], atol=1e-5)
    with pytest.raises(ValueError, match="crop: expected a window within 64 x 64"):
        augment.crop(whole, 40, 0, 32, 32)


def test_offsets_are_whole_centimetres():
    rng = np.random.default_rng(0)
    offsets = np.stack([augment.random_offset(rng, (0.05, 0.02, 0)) for _ in range(500)])
    centimetres = offsets * 100
    np.testing.assert_allclose(centimetres, np.rint(centimetres), atol=1e-5)
    np.testing.assert_array_equal(np.rint(centimetres).max(0), [5, 2, 0])
    np.testing.assert_array_equal(np.rint(centimetres).min(0), [-5, -2, 0])


def test_noise_changes_what_it_says_and_nothing_else():
    frame = decode_frame(random_episode(0), 0)
    before = copy.deepcopy(arrays_of(frame))
    variations = {
        "robot.pose": lambda rng: augment.jitter_state(frame, rng, 0.02, 1.0),
        "keypoint": lambda rng: augment.perturb_keypoint(frame, rng, 0.03, 1.0),
        "pictures.rgb": lambda rng: augment.vary_colour(frame, rng),
    }
    for changed, vary in variations.items():
        result = arrays_of(vary(np.random.default_rng(1)))
        again = arrays_of(vary(np.random.default_rng(1)))
        for name, value in arrays_of(frame).items():
            np.testing.assert_array_equal(value, before[name])
            np.testing.assert_array_equal(result[name], again[name])
            assert np.array_equal(result[name], value) == (name != changed)
    moved = variations["keypoint"](np.random.default_rng(2)).keypoint - frame.keypoint
    assert 0 < np.abs(moved).max() <= 0.03 + 1e-6
    assert augment.perturb_keypoint(frame, np.random.default_rng(0), 0.03, 0.0) is frame
    assert np.array_equal(augment.vary_colour(frame, np.random.default_rng(0), 0.0).pictures.rgb, frame.pictures.rgb)
