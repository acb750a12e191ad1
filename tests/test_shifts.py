"""The four axes along which test conditions leave those of training: each changes what it says, and nothing else."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dsvla_jax.errors import UserError
from dsvla_jax.geometry.cameras import project
from dsvla_jax.sim.environment import Environment
from dsvla_jax.sim.seeds import episode_keys
from dsvla_jax.sim.shifts import OFFSET, SHIFTS
from dsvla_jax.types import TABLE_HEIGHT

TASK, EPISODES = "put_rubbish_in_bin", 4


@functools.cache
def environment(*shifts: str) -> Environment:
    return Environment(TASK, image_size=64, shifts=shifts)


def start(*shifts: str):
    return environment(*shifts).reset(episode_keys(3, "validation", TASK, 0, EPISODES))


@pytest.mark.parametrize("name", SHIFTS)
def test_a_shift_changes_what_is_seen_and_repeats(name):
    plain, shifted, again = start(), start(name), start(name)
    seen = [
        np.asarray(environment(*([name] * (s is not plain))).observe(s).pictures.rgb) for s in (plain, shifted, again)
    ]
    np.testing.assert_array_equal(seen[1], seen[2])
    assert (seen[0] != seen[1]).any(axis=(1, 2, 3)).all()


def test_other_views_are_calibrated():
    # A point on the table is where the shifted picture's own camera says, seen in the depth.
    state = start("camera")
    observation = environment("camera").observe(state)
    corner = jnp.array([0.35, 0.3, TABLE_HEIGHT])
    for i in range(EPISODES):
        camera = jax.tree.map(lambda x, i=i: x[i, 0], observation.pictures.camera)
        (u, v), depth = project(corner, camera)
        assert 0 <= u < 64
        np.testing.assert_allclose(observation.pictures.depth[i, 0, round(float(v)), round(float(u))], depth, atol=0.02)
    assert len(np.unique(np.asarray(observation.pictures.camera.world_from_camera), axis=0)) == EPISODES


def test_positions_move_each_body_by_a_little():
    plain, shifted = start(), start("position")
    layout = environment().scene.layout
    moves = []
    for name, address in layout.free.items():
        moves.append(np.asarray(shifted.qpos - plain.qpos)[:, address : address + 2])
        assert 0 < np.abs(moves[-1]).max() < OFFSET + 0.005, name
    assert np.abs(moves[0] - moves[1]).max() > 0.005


def test_other_instances_keep_their_footing_and_the_expert_succeeds():
    env, state = environment("instance"), start("instance")
    sizes = np.asarray(state.geom_size)[:, env.scene.mj_model.geom("rubbish").id]
    assert (sizes.std(axis=0) > 1e-4).all()
    heights = jax.vmap(lambda s: env.view(s).body_pose("rubbish")[2])(state)
    np.testing.assert_allclose(heights - TABLE_HEIGHT, sizes[:, 2], atol=2e-3)
    plan = env.expert(state)
    assert np.asarray(env.success(env.follow(state, plan)[-1])).sum() >= EPISODES - 1


def test_clutter_stands_on_the_table_in_view():
    env, state = environment("background"), start("background")
    model = env.scene.mj_model
    segmentation = np.asarray(env.render(state)[2])
    clutter = [i for i in range(model.ngeom) if model.geom(i).name.startswith("clutter")]
    for picture in segmentation:
        assert np.isin(clutter, picture).sum() >= 3


def test_an_unknown_shift_is_named():
    with pytest.raises(UserError, match="unknown shift 'colour': expected some of instance, position"):
        Environment(TASK, shifts=("colour",))
