"""What an episode has been: recorded, kept by the closed loop and by the server, and read by policies."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from data_pipelines.augment import shift_world
from data_pipelines.records import decode_frame
from dsvla_jax.encoding.past import first_past, recorded_past, remember
from dsvla_jax.evaluation.loop import run_episodes
from dsvla_jax.serving.requests import Request
from dsvla_jax.serving.session import Session
from dsvla_jax.sim.environment import Environment
from dsvla_jax.sim.seeds import episode_keys
from dsvla_jax.types import LOOK_BACK, Action, Observation, Past, RobotState
from tests.random_data import random_episode


def assert_equal(one: Past, other: Past) -> None:
    jax.tree.map(np.testing.assert_array_equal, one, other)


@pytest.mark.parametrize("library", [np, jnp])
def test_remembering_an_episode_is_its_recorded_past(library):
    episode = random_episode(0, arms=2, frames=7, size=32)
    states = [
        RobotState(library.asarray(pose)[None], library.asarray(gripper)[None])
        for pose, gripper in zip(episode.pose, episode.gripper_open, strict=True)
    ]
    past = first_past(states[0])
    for frame, state in enumerate(states):
        recorded = recorded_past(episode.pose, episode.gripper_open, frame)
        assert_equal(jax.tree.map(lambda leaf: leaf[0], past), recorded)
        assert isinstance(past.robot.pose, np.ndarray) == (library is np)
        past = remember(past, state)
    last = recorded_past(episode.pose, episode.gripper_open, 6).robot.pose
    np.testing.assert_array_equal(last[-1], episode.pose[5])
    np.testing.assert_array_equal(last[0], episode.pose[6 - LOOK_BACK])


def test_a_shifted_world_has_a_shifted_past():
    frame = decode_frame(random_episode(3, frames=3, size=32), 2)
    moved = shift_world(frame, np.array([0.1, -0.2, 0.0]))
    assert frame.past is not None
    assert moved.past is not None
    difference = moved.past.robot.pose - frame.past.robot.pose
    np.testing.assert_allclose(difference[..., :3], np.tile([0.1, -0.2, 0.0], (LOOK_BACK, 1, 1)), atol=1e-6)
    assert not difference[..., 3:].any()


def test_the_closed_loop_tells_a_policy_what_was():
    environment = Environment("lamp_on", image_size=32)
    start = environment.reset(episode_keys(0, "validation", "lamp_on", 0, 2))
    seen: list[Observation] = []

    def act(observation: Observation, instructions: object, keypoints: np.ndarray) -> tuple[Action, list[str]]:
        seen.append(observation)
        robot = observation.robot
        return Action(robot.pose, robot.gripper_open), ["", ""]

    run_episodes(environment, act, start, limit=3)
    past = first_past(seen[0].robot)
    for observation in seen:
        assert observation.past is not None
        assert_equal(observation.past, past)
        past = remember(past, observation.robot)
    assert np.asarray(seen[-1].past and seen[-1].past.keyframes).tolist() == [2, 2]


def test_a_connection_remembers_an_episode_and_forgets_it_when_another_begins():
    episode, session = random_episode(0, frames=4, size=32), Session()

    def look_back(frame: int, instruction: str = "do it", reset: bool = False) -> Past[np.ndarray]:
        decoded = decode_frame(episode, frame)
        request = Request(instruction, Observation(decoded.pictures, decoded.robot), None, reset)
        return session.look_back(request, begins=False)

    for frame in range(3):
        assert_equal(look_back(frame), recorded_past(episode.pose, episode.gripper_open, frame))
    alone = recorded_past(episode.pose[3:], episode.gripper_open[3:], 0)
    assert_equal(look_back(3, reset=True), alone)
    assert_equal(look_back(3, "do another"), alone)


def test_a_frame_knows_its_place():
    episode = random_episode(0, frames=4, size=32)
    frames = [decode_frame(episode, place) for place in range(4)]
    assert [frame.past and int(frame.past.keyframes) for frame in frames] == [0, 1, 2, 3]
    assert frames[3].past is not None
    np.testing.assert_array_equal(frames[3].past.robot.pose[-1], frames[2].robot.pose)
