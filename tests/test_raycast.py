# pyright: reportAttributeAccessIssue=false
import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from benchmarks.raycast_parity import NO_OPENGL, compare, mujoco_rays, primitive_scene, raycast_view
from dsvla_jax.geometry.cameras import front_camera, project, unproject
from dsvla_jax.sim import raycast

SIZE = 96
KINDS = mujoco.mjtGeom


@pytest.fixture(scope="module")
def camera():
    return front_camera(SIZE)


def scene(*geoms):
    """A model of world geoms and its data, at rest."""
    spec = mujoco.MjSpec()
    for geom in geoms:
        spec.worldbody.add_geom(**geom)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


def arrays(model, data):
    return tuple(jnp.asarray(a, jnp.float32) for a in (data.geom_xpos, data.geom_xmat, model.geom_rgba))


FLOOR = {"type": KINDS.mjGEOM_PLANE, "size": [0, 0, 1], "rgba": [0.5, 0.5, 0.5, 1]}
TABLE = {"type": KINDS.mjGEOM_PLANE, "size": [0.5, 0.4, 1], "pos": [0.2, 0, 0.752], "rgba": [0.8, 0.8, 0.8, 1]}
BLOCK = {"type": KINDS.mjGEOM_BOX, "size": [0.05, 0.05, 0.02], "pos": [0.2, 0.1, 1.0], "rgba": [0.8, 0.2, 0.2, 1]}


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_all_primitives_agree_with_mujocos_rays(camera, seed):
    model = primitive_scene(seed)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    _, depth, segmentation = raycast_view(model, data, camera, SIZE)
    drawn = {int(model.geom_type[i]) for i in np.unique(segmentation) if i >= 0}
    assert drawn == {raycast.PLANE, raycast.SPHERE, raycast.ELLIPSOID, raycast.CAPSULE, raycast.CYLINDER, raycast.BOX}
    parity = compare(segmentation, depth, *mujoco_rays(model, data, camera, SIZE))
    assert parity.agreement >= 0.999
    assert parity.depth_p99 < 1e-3


def test_agrees_with_the_opengl_renderer():
    """In its own process: the OpenGL back end is chosen by the environment before mujoco is imported."""
    command = [sys.executable, "-m", "benchmarks.raycast_parity", "--primitives-only", "--gl", "--size", "160"]
    environment = {"MUJOCO_GL": "egl", **os.environ}
    root = Path(__file__).parents[1]
    run = subprocess.run(command, cwd=root, env=environment, capture_output=True, text=True, timeout=300)
    if run.returncode == NO_OPENGL or "initialize an EGL" in run.stderr or "OpenGL" in run.stderr:
        pytest.skip(
            f"no OpenGL context can be made here (install libegl1 libgl1-mesa-dri): {run.stderr.strip()[-200:]}"
        )
    assert run.returncode == 0, run.stdout + run.stderr


def test_depth_is_planar_and_unprojects_onto_the_surfaces(camera):
    ball = {"type": KINDS.mjGEOM_SPHERE, "size": [0.1, 0, 0], "pos": [0.1, -0.2, 1.1]}
    model, data = scene(TABLE, ball)
    _, depth, segmentation = raycast_view(model, data, camera, SIZE)
    points = np.asarray(unproject(jnp.asarray(depth), camera))
    np.testing.assert_allclose(points[segmentation == 0][:, 2], 0.752, atol=1e-5)
    radius = np.linalg.norm(points[segmentation == 1] - [0.1, -0.2, 1.1], axis=1)
    np.testing.assert_allclose(radius, 0.1, atol=1e-5)
    (u, v), _ = project(jnp.array([0.1, -0.2, 1.1]), camera)
    assert segmentation[int(v), int(u)] == 1


def test_a_plane_is_one_sided(camera):
    away = {"quat": [0.5**0.5, 0, -(0.5**0.5), 0], "size": [0.2, 0.2, 1], "pos": [0.5, 0, 1.2]}
    model, data = scene({"type": KINDS.mjGEOM_PLANE, **away}, TABLE)
    assert 0 not in raycast_view(model, data, camera, SIZE)[2]
    away["quat"] = [0.5**0.5, 0, 0.5**0.5, 0]
    model, data = scene({"type": KINDS.mjGEOM_PLANE, **away}, TABLE)
    assert 0 in raycast_view(model, data, camera, SIZE)[2]


def test_nothing_hit_is_depth_zero_and_far_surfaces_keep_their_id(camera):
    model, data = scene(BLOCK)
    _, depth, segmentation = raycast_view(model, data, camera, SIZE)
    np.testing.assert_array_equal(depth == 0, segmentation == -1)
    assert (segmentation == -1).any()
    model, data = scene(FLOOR)
    _, unlimited, _ = raycast_view(model, data, camera, SIZE)
    _, depth, segmentation = raycast_view(model, data, camera, SIZE, far=4.5)
    assert unlimited.max() > 4.5
    np.testing.assert_array_equal(depth, np.where(unlimited <= 4.5, unlimited, 0))
    assert (segmentation == 0).all()


def test_hidden_geoms_are_not_drawn(camera):
    shields = [{**BLOCK, "pos": [0.8, 0, 1.3], "size": [0.01, 2, 2]} for _ in range(2)]
    shields[0]["group"], shields[1]["rgba"] = 3, [1, 1, 1, 0]
    model, data = scene(TABLE, *shields)
    assert raycast.primitives_from_model(model).groups == ((raycast.PLANE, (0,)),)
    model, data = scene(TABLE, BLOCK)
    primitives = raycast.primitives_from_model(model)
    xpos, xmat, rgba = arrays(model, data)
    assert (raycast.render(primitives, xpos, xmat, rgba, camera, SIZE, SIZE)[2] == 1).any()
    transparent = raycast.render(primitives, xpos, xmat, rgba.at[1, 3].set(0), camera, SIZE, SIZE)
    only_table = raycast_view(*scene(TABLE), camera, SIZE)
    for got, expected in zip(transparent, only_table, strict=True):
        np.testing.assert_array_equal(got, expected)


def test_the_shadow_lies_where_the_light_throws_it(camera):
    model, data = scene(TABLE, BLOCK)
    primitives = raycast.primitives_from_model(model)
    lit, _, _ = raycast.render(primitives, *arrays(model, data), camera, SIZE, SIZE, shadows=False)
    shaded, _, segmentation = raycast.render(primitives, *arrays(model, data), camera, SIZE, SIZE)
    dark = np.asarray((shaded < lit).any(-1))
    light = np.asarray(primitives.light_direction)
    centre = np.array(BLOCK["pos"]) + light * (0.752 - BLOCK["pos"][2]) / light[2]
    (u, v), _ = project(jnp.asarray(centre, jnp.float32), camera)
    assert dark[int(v), int(u)]
    assert segmentation[int(v), int(u)] == 0
    # A box on its side lit from above has faces turned away from the light, but casts nothing onto its lit ones.
    assert not dark[np.asarray(segmentation) == 1].any()
    assert 0 < dark.sum() < 0.1 * dark.size


def test_a_batch_equals_its_pictures(camera):
    model, data = scene(TABLE, BLOCK)
    primitives = raycast.primitives_from_model(model)
    xpos, xmat, rgba = arrays(model, data)
    batch = (jnp.stack([xpos, xpos + 0.05]), jnp.stack([xmat, xmat]), jnp.stack([rgba, rgba[:, ::-1].at[:, 3].set(1)]))
    together = jax.vmap(lambda *a: raycast.render(primitives, *a, camera, SIZE, SIZE))(*batch)
    for i in range(2):
        alone = raycast.render(primitives, *(a[i] for a in batch), camera, SIZE, SIZE)
        np.testing.assert_array_equal(together[2][i], alone[2])
        np.testing.assert_allclose(together[1][i], alone[1], atol=1e-4)
        assert np.abs(np.asarray(together[0][i], int) - np.asarray(alone[0], int)).max() <= 1


def test_rows_traced_in_blocks_make_the_same_picture(camera):
    """A picture too tall to be traced at once begins with the rows of a small one: the camera is the same."""
    tall = 4 * SIZE
    assert SIZE * SIZE < raycast.MAX_BLOCK_RAYS < tall * SIZE
    model, data = scene(TABLE, BLOCK)
    primitives = raycast.primitives_from_model(model)
    small = raycast.render(primitives, *arrays(model, data), camera, SIZE, SIZE)
    for blocked, expected in zip(
        raycast.render(primitives, *arrays(model, data), camera, tall, SIZE), small, strict=True
    ):
        np.testing.assert_allclose(np.asarray(blocked[:SIZE], float), np.asarray(expected, float), atol=1e-5)


def test_a_mesh_is_refused_by_name():
    spec = mujoco.MjSpec()
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)
    spec.add_mesh(name="tetrahedron", uservert=corners.reshape(-1))
    spec.worldbody.add_geom(name="odd_shape", type=KINDS.mjGEOM_MESH, meshname="tetrahedron")
    with pytest.raises(ValueError, match=r"odd_shape.*MESH"):
        raycast.primitives_from_model(spec.compile())
