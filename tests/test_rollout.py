"""The closed loop on the host with scripted policies: what ends an episode, and which reason is given."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dsvla_jax.errors import UserError
from dsvla_jax.evaluation.loop import Stopped, on_host, run_episodes, run_task
from dsvla_jax.evaluation.pictures import mark_view
from dsvla_jax.perception.simulator import SegmentationKeypoints
from dsvla_jax.sim.environment import Environment
from dsvla_jax.sim.physics import SimState
from dsvla_jax.sim.seeds import episode_keys
from dsvla_jax.types import Action
from tests.serving import tiny_policy

EPISODES = 4


@functools.cache
def environment(task: str) -> Environment:
    return Environment(task, image_size=32)


def keys_of(task: str) -> jax.Array:
    return episode_keys(11, "validation", task, 0, EPISODES)


def follow(plan: Action):
    """A policy that answers with the keyframes of a plan (B, M, A, ...), then with the last of them."""
    poses, grippers = np.asarray(plan.pose), np.asarray(plan.gripper_open)
    steps = iter(range(10**6))

    def act(observation, instructions, keypoints):
        m = min(next(steps), poses.shape[1] - 1)
        return Action(jnp.asarray(poses[:, m]), jnp.asarray(grippers[:, m])), [f"keyframe {m}"] * len(instructions)

    return act


def start_of(task: str) -> SimState:
    return environment(task).reset(keys_of(task))


def plan_of(task: str) -> Action:
    return environment(task).expert(start_of(task))


def reasons(task: str, plan: Action) -> list[str]:
    return [ending.reason for ending in run_episodes(environment(task), follow(plan), start_of(task))]


def test_a_task_is_run_in_batches_from_the_seeds_of_its_split():
    poses, grippers = (np.asarray(part) for part in (plan_of("lamp_on").pose, plan_of("lamp_on").gripper_open))
    calls = []

    def act(observation, instructions, keypoints):
        batch, m = divmod(len(calls), poses.shape[1])
        rows = slice(2 * batch, 2 * batch + 2)
        calls.append(len(instructions))
        return Action(jnp.asarray(poses[rows, m]), jnp.asarray(grippers[rows, m])), ["go"] * len(instructions)

    lamp = environment("lamp_on")
    endings = run_task(lamp, on_host(lamp, act), 3, split="validation", seed=11, batch=2)
    # The plans are those of these seeds in this order: from other starts they would not succeed.
    assert [ending.success for ending in endings] == [True] * 3
    assert calls == [2] * (2 * poses.shape[1]), "the last batch is filled up"


def test_an_episode_is_the_same_whatever_the_size_of_the_batch():
    """Its paraphrase, and the noise on its keypoints."""

    lamp = environment("lamp_on")

    def asked(batch: int) -> list[tuple[str, np.ndarray]]:
        calls = []

        def act(observation, instructions, keypoints):
            calls.append(list(zip(instructions, keypoints, strict=True)))
            return Action(jnp.asarray(observation.robot.pose), jnp.asarray(observation.robot.gripper_open)), [
                ""
            ] * batch

        run_task(lamp, on_host(lamp, act), EPISODES, split="validation", batch=batch, keypoint_noise=0.1)
        return [turn for call in calls[:: 2 * lamp.expert_keyframes] for turn in call]

    in_twos, at_once = asked(2), asked(EPISODES)
    assert len({instruction for instruction, _ in in_twos}) > 2
    for (one, near), (other, likewise) in zip(in_twos, at_once, strict=True):
        assert one == other
        np.testing.assert_array_equal(near, likewise)


def test_no_episodes_are_no_evaluation():
    lamp = environment("lamp_on")
    run = on_host(lamp, follow(plan_of("lamp_on")))
    for episodes, batch in ((0, 2), (2, 0), (2, -3)):
        with pytest.raises(UserError, match="expected at least 1 of each"):
            run_task(lamp, run, episodes, split="validation", batch=batch)


def test_episodes_are_given_up_after_a_keyframe():
    plan, asked = plan_of("lamp_on"), []

    def stop() -> bool:
        asked.append(True)
        return len(asked) == 2

    lamp = environment("lamp_on")
    with pytest.raises(Stopped):
        run_task(lamp, on_host(lamp, follow(plan)), EPISODES, split="validation", seed=11, stop=stop)
    assert len(asked) == 2


def test_an_episode_ends_with_its_success():
    plan = plan_of("put_rubbish_in_bin")
    endings = run_episodes(environment("put_rubbish_in_bin"), follow(plan), start_of("put_rubbish_in_bin"))
    for ending in endings:
        assert ending.success
        assert ending.reason == ""
        assert ending.keyframes == plan.pose.shape[1] == len(ending.answers) == len(ending.targets)
        assert len(ending.views) == ending.keyframes + 1
        assert "rubbish" in ending.instruction or "trash" in ending.instruction or "paper" in ending.instruction


def test_a_perfect_grasp_holds_the_rubbish():
    """Starts at which lighter rubbish shoots out of the fingers."""
    bin_ = environment("put_rubbish_in_bin")
    keys = [episode_keys(0, "eval", "put_rubbish_in_bin", number, 1) for number in (2, 61, 104, 230)]
    start = bin_.reset(jnp.concatenate(keys))
    endings = run_episodes(bin_, follow(bin_.expert(start)), start)
    assert [ending.reason for ending in endings] == [""] * EPISODES


def test_each_failure_has_its_reason():
    task = "put_rubbish_in_bin"
    plan, start = plan_of(task), start_of(task)
    nothing = Action(plan.pose[:, :1], plan.gripper_open[:, :1])
    assert reasons(task, nothing) == ["time-out"] * EPISODES

    beyond = Action(plan.pose.at[..., 0].add(5.0), plan.gripper_open)
    assert reasons(task, beyond) == ["a pose was out of reach"] * EPISODES

    # The rubbish is let go of over the table.
    dropped = Action(plan.pose[:, :3], plan.gripper_open[:, :3].at[:, 2].set(1.0))
    assert reasons(task, dropped) == ["dropped the object"] * EPISODES

    tomato = jax.vmap(lambda state: environment(task).view(state).body_pose("rubbish_tomato_left"))(start)
    wrong = Action(plan.pose.at[:, :2, 0, :2].set(tomato[:, None, :2]), plan.gripper_open)
    assert reasons(task, wrong) == ["took the wrong object"] * EPISODES


@pytest.mark.slow
@pytest.mark.parametrize(("task", "shifts"), [("lamp_on", ()), ("bimanual_lift_ball", ("instance",))])
def test_episodes_end_alike_in_mjx(task, shifts):
    """One arm and two; the balls of other sizes besides, which each stepper gives to its own models."""
    ends = {}
    for physics in ("mujoco", "mjx"):
        env = Environment(task, physics, image_size=32, shifts=shifts)
        start = env.reset(keys_of(task))
        ends[physics] = run_episodes(env, follow(env.expert(start)), start)
        ends[physics, "start"] = np.asarray(start.qpos)
    np.testing.assert_allclose(ends["mujoco", "start"], ends["mjx", "start"], atol=1e-3)
    assert [end.success for end in ends["mujoco"]] == [end.success for end in ends["mjx"]]
    assert sum(end.success for end in ends["mjx"]) >= EPISODES - 1


def test_keypoints_of_the_segmentation_are_the_first_frames_or_refreshed():
    """The rubbish is carried to the bin: what was found first stays, what is looked for again goes with it."""
    env = Environment("put_rubbish_in_bin", image_size=96)
    start = env.reset(keys_of("put_rubbish_in_bin"))
    states = env.follow(start, env.expert(start))
    first, refreshed = (SegmentationKeypoints(env, start, refresh) for refresh in (False, True))
    found = [(first(state, env.observe(state)), refreshed(state, env.observe(state))) for state in states]
    for (kept, missing), _ in found:
        assert missing == [""] * EPISODES
        np.testing.assert_array_equal(kept, found[0][0][0])
        # The middle of the rubbish, 2 cm under its top, and that of the bin's opening, not of the bin's side.
        assert np.linalg.norm(kept - env.keypoints(start), axis=-1)[..., 0].max() < 0.03
    carried = found[3][1][0][:, 0, 0]
    assert np.linalg.norm(carried - env.keypoints(states[3])[:, 0, 0], axis=-1).max() < 0.04
    assert np.linalg.norm(carried - found[0][0][0][:, 0, 0], axis=-1).min() > 0.1


def test_an_episode_whose_object_is_not_seen_is_over_and_says_so():
    env = Environment("lamp_on", image_size=96)
    start, told = env.reset(keys_of("lamp_on")), []
    places = np.array(start.geom_xpos)
    places[1, env.scene.mj_model.geom("lamp_button").id] -= 5.0
    hidden = start.replace(geom_xpos=places)

    def act(observation, instructions, keypoints):
        told.append(keypoints)
        return Action(observation.robot.pose, observation.robot.gripper_open), ["stay"] * EPISODES

    endings = run_episodes(env, act, hidden, limit=2, find_keypoints=SegmentationKeypoints(env, hidden))
    reason = "keypoints not found: 'little green light switch': its mask is empty"
    assert [ending.reason for ending in endings] == ["time-out", reason, "time-out", "time-out"]
    assert [ending.keyframes for ending in endings] == [2, 0, 2, 2]
    seen = np.arange(EPISODES) != 1
    assert np.linalg.norm(told[1] - env.keypoints(start)[:, :, 0], axis=-1)[seen].max() < 0.03


def test_noise_moves_the_keypoints_that_the_policy_is_told():
    told = []

    def act(observation, instructions, keypoints):
        told.append(keypoints)
        return Action(observation.robot.pose, observation.robot.gripper_open), [""] * EPISODES

    for noise in (0.0, 0.05):
        run_episodes(environment("lamp_on"), act, start_of("lamp_on"), limit=1, noise=noise)
    np.testing.assert_allclose(told[1] - told[0], 0.05, atol=1e-6)


def test_a_policy_acts_with_what_two_cameras_see():
    cameras = ("front", "wrist")
    lamp = Environment("lamp_on", image_size=32, cameras=cameras)
    policy = tiny_policy(words=lamp.task.all_instructions(), cameras=cameras)
    state = lamp.reset(episode_keys(0, "validation", "lamp_on", 0, 2))
    seen = lamp.observe(state)
    endings = run_episodes(lamp, policy.act, state, limit=1)
    for i, ending in enumerate(endings):
        assert ending.keyframes == 1
        assert len(ending.views) == 2
        np.testing.assert_array_equal(ending.views[0].rgb, seen.pictures.rgb[i])
        np.testing.assert_array_equal(
            ending.views[0].camera.world_from_camera, seen.pictures.camera.world_from_camera[i]
        )
        # One column of the film strip: the front camera's picture above the wrist camera's, each with the target.
        column = mark_view(ending.views[0].rgb, ending.targets[0], ending.views[0].camera)
        assert column.shape == (64, 32, 3)
        np.testing.assert_array_equal(
            mark_view(ending.views[0].rgb, None, ending.views[0].camera)[32:], seen.pictures.rgb[i, 1]
        )
    without = dataclasses.replace(seen, pictures=jax.tree.map(lambda x: x[:, ::-1], seen.pictures))
    instructions, near = lamp.instructions(state), np.asarray(lamp.keypoints(state))[:, :, 0]
    one, other = (np.asarray(policy.decide(x, instructions, near).log_probs) for x in (seen, without))
    assert np.abs(one - other).max() > 1e-3
