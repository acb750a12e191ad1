"""The simulator's cameras: wrist cameras move with their hands, and all of them see one and the same scene."""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from dsvla_jax.errors import UserError
from dsvla_jax.geometry.cameras import front_camera, project, unproject
from dsvla_jax.sim.cameras import camera_names
from dsvla_jax.sim.environment import Environment
from dsvla_jax.sim.physics import SimState
from dsvla_jax.sim.seeds import episode_keys
from dsvla_jax.types import TABLE_HEIGHT, Action, Camera

TASKS = ("put_rubbish_in_bin", "bimanual_lift_tray")
SIZE, EPISODES = 96, 4


@functools.cache
def environment(task: str) -> Environment:
    arms = 2 if task.startswith("bimanual") else 1
    return Environment(task, image_size=SIZE, cameras=camera_names(arms))


@functools.cache
def somewhere(task: str) -> SimState:
    """Episodes whose hands are at random places over the table, turned and tilted at random."""
    env, random = environment(task), np.random.default_rng(5)
    state = env.reset(episode_keys(2, "validation", task, 0, EPISODES))
    sides = np.array([[0.0], [0.0]] if env.num_arms == 1 else [[0.3], [-0.3]])[: env.num_arms]
    position = random.uniform([0.05, -0.1, 0.95], [0.25, 0.1, 1.15], (EPISODES, env.num_arms, 3))
    position[..., 1] += sides[:, 0]
    tilt = random.uniform(-0.12, 0.12, (EPISODES, env.num_arms, 4)) + np.array([0, 1, 0, 0])
    pose = np.concatenate([position, tilt / np.linalg.norm(tilt, axis=-1, keepdims=True)], axis=-1)
    state = env.step(state, Action(jnp.asarray(pose, jnp.float32), jnp.ones((EPISODES, env.num_arms))))
    assert not np.any(state.ik_failed)
    return state


@pytest.mark.parametrize("task", TASKS)
def test_wrist_cameras_follow_their_hands(task):
    env, state = environment(task), somewhere(task)
    views, names = env.observe(state).pictures, env.cameras
    model, data = env.scene.mj_model, mujoco.MjData(env.scene.mj_model)
    for name in names:
        if not name.startswith("wrist"):
            continue
        poses = np.asarray(views.camera.world_from_camera)[:, names.index(name)]
        assert np.ptp(poses[:, :3, 3], axis=0).min() > 0.02
        site = "right_tcp" if name == "wrist_right" else "left_tcp"
        for pose, qpos in zip(poses, np.asarray(state.qpos), strict=True):
            data.qpos[:] = qpos
            mujoco.mj_kinematics(model, data)
            tool = data.site(site)
            relative = tool.xmat.reshape(3, 3).T @ (pose[:3, 3] - tool.xpos)
            np.testing.assert_allclose(relative, [-0.041, 0, -0.0975], atol=1e-5)
            # It looks where the tool points.
            np.testing.assert_allclose(pose[:3, 2], tool.xmat.reshape(3, 3)[:, 2], atol=1e-5)
            np.testing.assert_allclose(pose[:3, :3].T @ pose[:3, :3], np.eye(3), atol=1e-5)


@pytest.mark.parametrize("task", TASKS)
def test_all_cameras_see_surfaces_of_the_scene_that_the_front_camera_sees(task):
    """No camera's point is nearer to the front camera than what that one sees there, and many are just that."""
    views, names = environment(task).observe(somewhere(task)).pictures, environment(task).cameras
    assert views.rgb.shape == (EPISODES, len(names), SIZE, SIZE, 3)
    for i in range(EPISODES):
        cameras = [jax.tree.map(lambda x, i=i, c=c: x[i, c], views.camera) for c in range(len(names))]
        front = np.asarray(views.depth[i, names.index("front")])
        nearest, farthest = (blurred(np.where(front == 0, np.inf, front), f) for f in (np.min, np.max))
        for name, camera, depth in zip(names, cameras, np.asarray(views.depth[i]), strict=True):
            points = np.asarray(unproject(jnp.asarray(depth), camera))[depth > 0]
            pixels, distance = map(np.asarray, project(jnp.asarray(points), cameras[names.index("front")]))
            u, v = np.rint(pixels).astype(int).T
            inside = (distance > 0) & (u >= 0) & (u < SIZE) & (v >= 0) & (v < SIZE)
            u, v, distance = u[inside], v[inside], distance[inside]
            assert len(u) > 0.05 * depth.size, name
            assert (distance > nearest[v, u] - 0.02).mean() > 0.995, name
            shared = np.abs(distance - np.clip(distance, nearest[v, u], farthest[v, u])) < 0.01
            assert shared.mean() > 0.2, name


def blurred(picture: np.ndarray, of: Callable[..., np.ndarray]) -> np.ndarray:
    """The least or greatest of each pixel and its neighbours: at edges, rounding to a pixel may miss a surface."""
    padded = np.pad(picture, 1, mode="edge")
    return of([padded[i : i + SIZE, j : j + SIZE] for i in range(3) for j in range(3)], axis=0)


@pytest.mark.parametrize("names", [("front",), ("wrist", "front"), ("overhead",)])
def test_a_camera_sees_the_same_whatever_others_there_are(names):
    """The front camera's pixels are equal; others' are drawn by other programs, which differ at edges."""
    every, state = environment(TASKS[0]), somewhere(TASKS[0])
    all_pictures = every.observe(state).pictures
    some = Environment(TASKS[0], image_size=SIZE, cameras=names).observe(state).pictures
    for c, name in enumerate(names):
        one, same = (
            jax.tree.map(lambda x, c=c: np.asarray(x[:, c]), pictures)
            for pictures, c in ((some, c), (all_pictures, every.cameras.index(name)))
        )
        jax.tree.map(np.testing.assert_array_equal, one.camera, same.camera)
        if name == "front":
            np.testing.assert_array_equal(one.rgb, same.rgb)
            np.testing.assert_array_equal(one.rgb, every.render(state).rgb)
            np.testing.assert_array_equal(one.depth, every.render(state).depth)
        np.testing.assert_allclose(one.depth, same.depth, atol=1e-5)
        assert np.mean(one.rgb != same.rgb) < 1e-3


def test_fixed_cameras_have_rlbenchs_poses_and_look_at_the_table():
    """The matrices that RLBench records, as published with packaged datasets."""
    env = environment(TASKS[0])
    views, names = env.observe(somewhere(TASKS[0])).pictures.camera, env.cameras
    recorded = {
        "left_shoulder": [
            [0.17365, 0.89254, 0.41620, -0.175],
            [0.98481, -0.15738, -0.07339, 0.2],
            [0, 0.42262, -0.90631, 1.98],
        ],
        "right_shoulder": [
            [-0.17365, 0.89254, 0.41620, -0.175],
            [0.98481, 0.15738, 0.07339, -0.2],
            [0, 0.42262, -0.90631, 1.98],
        ],
        "front": [[0, -0.42262, -0.90631, 1.35], [-1, 0, 0, 0], [0, 0.90631, -0.42262, 1.58]],
    }
    for name, pose in recorded.items():
        camera = names.index(name)
        np.testing.assert_allclose(views.world_from_camera[0, camera, :3], pose, atol=1e-4)
        np.testing.assert_allclose(views.intrinsics[0, camera], front_camera(SIZE).intrinsics, rtol=1e-6)
    # 256 pixels and a focal length of 221.7.
    np.testing.assert_allclose(views.intrinsics[0, names.index("wrist"), 0, 0], -221.7025 * SIZE / 256, rtol=1e-5)
    middle = jnp.array([0.15, 0.0, TABLE_HEIGHT])
    for name in ("left_shoulder", "right_shoulder", "overhead"):
        camera = Camera(*(x[0, names.index(name)] for x in (views.intrinsics, views.world_from_camera)))
        pixel, depth = project(middle, camera)
        assert depth > 0
        assert (np.abs(np.asarray(pixel) - SIZE / 2) < SIZE / 2).all()


def test_unknown_and_repeated_cameras_are_named():
    for cameras in (("side",), ("front", "front"), (), ("wrist_left",)):
        with pytest.raises(UserError, match=r"cameras: expected some of front, left_shoulder, .*, wrist, each once"):
            Environment("lamp_on", cameras=cameras)
    assert camera_names(2)[-2:] == ("wrist_left", "wrist_right")
