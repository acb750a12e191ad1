"""Every task: its expert succeeds, doing nothing does not, and what an episode needs is in view and within reach."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.expert_success import run_expert
from benchmarks.robustness import torment
from dsvla_jax.errors import UserError
from dsvla_jax.geometry.cameras import project
from dsvla_jax.sim.environment import Environment
from dsvla_jax.sim.seeds import episode_keys
from dsvla_jax.sim.tasks import TASKS, colours, get_task
from dsvla_jax.types import TABLE_HEIGHT, Action

EPISODES = 8


@pytest.fixture(scope="module", params=TASKS)
def environment(request) -> Environment:
    return Environment(request.param, image_size=96)


def keys_of(environment: Environment):
    return episode_keys(7, "validation", environment.task.name, 0, EPISODES)


def test_expert_succeeds_and_doing_nothing_does_not(environment: Environment):
    outcome = run_expert(environment, keys_of(environment))
    assert outcome["expert"].sum() >= EPISODES - 1
    assert not outcome["at reset"].any()
    assert not outcome["idle"].any()


def test_keypoints_are_in_view_and_above_the_table(environment: Environment):
    state = environment.reset(keys_of(environment))
    keypoints = np.asarray(environment.keypoints(state))
    assert keypoints.shape[:2] == (EPISODES, environment.num_arms)
    pixels, depth = project(jnp.asarray(keypoints), environment.camera)
    assert (np.asarray(depth) > 0).all()
    assert (np.asarray(pixels) >= 0).all()
    assert (np.asarray(pixels) < 96).all()
    assert (keypoints[..., 2] > TABLE_HEIGHT).all()


def test_episodes_differ_and_repeat_by_seed(environment: Environment):
    keys = keys_of(environment)
    first, again = (np.asarray(environment.keypoints(environment.reset(keys))) for _ in range(2))
    np.testing.assert_array_equal(first, again)
    assert len(np.unique(first.reshape(EPISODES, -1).round(4), axis=0)) == EPISODES


def test_the_wrong_object_in_the_bin_is_no_success():
    environment = Environment("put_rubbish_in_bin")
    start = environment.reset(keys_of(environment))
    plan = environment.expert(start)
    tomato = np.asarray(jax.vmap(lambda s: environment.view(s).body_pose("rubbish_tomato_left"))(start))
    rubbish = np.asarray(plan.pose)[:, 1, 0, :2]
    shift = np.zeros((EPISODES, 3), np.float32)
    shift[:, :2] = tomato[:, :2] - rubbish
    state = start
    for m in range(plan.pose.shape[1]):
        # The same motions around the tomato; the bin's is the last.
        offset = shift if m < plan.pose.shape[1] - 1 else np.zeros_like(shift)
        pose = np.asarray(plan.pose[:, m]).copy()
        pose[..., :3] += offset[:, None]
        state = environment.step(state, Action(jnp.asarray(pose), plan.gripper_open[:, m]))
    assert not np.asarray(environment.success(state)).any()


def test_a_tower_of_too_few_blocks_or_of_others_is_no_success():
    environment = Environment("stack_blocks")
    start = environment.reset(keys_of(environment)[:2], variation=jnp.full(2, 1))  # three blocks
    fewer = environment.expert(start.replace(variation=jnp.zeros(2, jnp.int32)))  # two
    others = start.replace(qpos=swapped_blocks(environment, np.array(start.qpos)))
    for state, plan in ((start, fewer), (others, environment.expert(start))):
        plan = jax.tree.map(lambda x: x[:, :17], plan)  # the keyframes of three blocks
        assert not np.asarray(environment.success(environment.follow(state, plan)[-1])).any()


def swapped_blocks(environment: Environment, qpos: np.ndarray) -> np.ndarray:
    """The blocks of the named colour and the others in each other's places."""
    free = environment.scene.layout.free
    for i in range(4):
        target, other = (
            slice(free[f"stack_{kind}{i}"], free[f"stack_{kind}{i}"] + 7) for kind in ("target", "distractor")
        )
        qpos[:, target], qpos[:, other] = qpos[:, other], qpos[:, target].copy()
    return qpos


@pytest.mark.parametrize("name", TASKS)
def test_a_colour_that_is_named_is_kept_where_colours_are_varied(name):
    words = {word for text in TASKS[name].all_instructions() for word in text.split()}
    assert TASKS[name].colours_matter or not words & {*colours.NAMES, "grey"}


@pytest.mark.parametrize("name", ["put_rubbish_in_bin", "bimanual_lift_tray"])
def test_hostile_actions_and_noise_leave_every_state_finite(name):
    assert torment(name, keyframes=10) == []


def test_unknown_task_names_the_nearest():
    with pytest.raises(UserError, match=r"unknown task 'lamp_of': did you mean 'lamp_on'\?"):
        get_task("lamp_of")
