"""The four axes along which test conditions leave those of training: each changes what it says, and nothing else."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from data_pipelines.demos import ScriptedExpert, Settings, generate_demonstrations
from data_pipelines.episodes import EpisodeReader
from data_pipelines.records import decode_frame
from dsvla_jax.errors import DataError, UserError
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


def test_demonstrations_under_other_conditions_say_so(tmp_path):
    """Every episode has a camera of its own, and the folder is not continued without the shift."""
    options = {"image_size": 24, "batch": 2, "perturb": 0.0, "keypoints": "oracle"}
    shifted = Settings(**options, shift=("camera",))
    expert = ScriptedExpert("lamp_on", shifted)
    generate_demonstrations(
        tmp_path, ["lamp_on"], 2, demonstrator=lambda *_: expert, progress=False, **options, shift=("camera",)
    )
    reader = EpisodeReader(tmp_path)
    seen = expert.environment.observe(expert.environment.reset(episode_keys(0, "train", "lamp_on", 0, 2)))
    for number in range(2):
        frame = decode_frame(reader.episode(number), 0)
        np.testing.assert_array_equal(frame.pictures.rgb, seen.pictures.rgb[number])
        np.testing.assert_array_equal(
            frame.pictures.camera.world_from_camera, seen.pictures.camera.world_from_camera[number]
        )
    one, other = (reader.episode(number).world_from_camera[0] for number in range(2))
    assert np.abs(one - other).max() > 0.01
    with pytest.raises(DataError, match=r"settings.shift: expected \[\] as asked for, got \['camera'\]"):
        generate_demonstrations(tmp_path, ["lamp_on"], 2, demonstrator=lambda *_: expert, progress=False, **options)
    with pytest.raises(UserError, match="unknown shift 'weather'"):
        Settings(shift=("weather",))
