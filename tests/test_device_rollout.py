"""The closed loop on the device against the one on the host, both stepping MJX."""

import dataclasses

import numpy as np
import pytest

from dsvla_jax.encoding.displacement import DisplacementScale
from dsvla_jax.encoding.prompts import format_answer
from dsvla_jax.evaluation.device_rollout import DeviceRollout
from dsvla_jax.evaluation.rollout import run_episodes
from dsvla_jax.perception.simulator import SegmentationKeypoints
from dsvla_jax.sim.environment import Environment
from dsvla_jax.sim.seeds import episode_keys
from tests.serving import SIZE, tiny_policy


@pytest.mark.slow
def test_both_loops_give_the_same_episodes():
    environment = Environment("lamp_on", "mjx", image_size=SIZE)
    policy = tiny_policy()
    state = environment.reset(episode_keys(0, "validation", "lamp_on", 0, 3))
    source = SegmentationKeypoints(environment, state)
    found, problems = source(state, environment.observe(state))
    assert problems == [""] * 3
    endings = run_episodes(environment, policy.act, state, limit=3, find_keypoints=source)
    rollout = DeviceRollout(environment, policy, limit=3)(state, found)
    style = policy.config.encoding.style
    for i, ending in enumerate(endings):
        assert rollout.keyframes[i] == ending.keyframes
        answers = [format_answer(np.asarray(rollout.integers)[k, i], style) for k in range(ending.keyframes)]
        assert answers == ending.answers
        assert bool(rollout.state.verdict.succeeded[i]) == ending.success
    assert len({answer for ending in endings for answer in ending.answers}) > 1


def test_what_only_the_host_loop_can_do_is_refused():
    environment, policy = Environment("lamp_on", image_size=SIZE), tiny_policy()
    with pytest.raises(ValueError, match=r"expected Environment.*physics='mjx'"):
        DeviceRollout(environment, policy)
    config = dataclasses.replace(policy.config, displacement=DisplacementScale((-1.0,) * 6, (1.0,) * 6))
    with pytest.raises(ValueError, match=r"answers with displacements; run it with rollout\.run_episodes"):
        DeviceRollout(environment, dataclasses.replace(policy, config=config))
