"""The range of answers that is fitted to demonstrations: from data to a policy that acts."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from data_pipelines.records import decode_frame
from data_pipelines.samples import without_variation
from data_pipelines.training_data import open_training_data
from dsvla_jax.encoding.vector_scale import VectorScale, fit_vector_scale
from dsvla_jax.model.config import ModelConfig
from dsvla_jax.policies.config import BehaviourCloningConfig, DP3Config, PolicyConfig
from dsvla_jax.policies.registry import make_learner, make_policy
from dsvla_jax.suite_vocabulary import suite_tokenizer, tokenizer_of
from dsvla_jax.training.sharding import BatchPart
from dsvla_jax.types import Observation
from tests.odd_settings import toy_experiment
from tests.random_data import random_episode
from tests.small import small_encoding


def test_a_scale_stretches_what_varies_and_moves_what_does_not():
    vectors = np.random.default_rng(0).uniform(-3, 5, (50, 4)).astype(np.float32)
    vectors[:, 2] = 0.7
    scale = fit_vector_scale(vectors)
    unit = np.asarray(scale.to_unit(jnp.asarray(vectors)))
    np.testing.assert_allclose(unit.min(axis=0), [-1, -1, 0, -1], atol=1e-6)
    np.testing.assert_allclose(unit.max(axis=0), [1, 1, 0, 1], atol=1e-6)
    np.testing.assert_allclose(scale.from_unit(jnp.asarray(unit)), vectors, atol=1e-5)
    with pytest.raises(ValueError, match="expected as many low <= high"):
        VectorScale((1.0,), (0.0,))


def test_a_policy_that_has_learned_nothing_answers_with_the_middle_of_the_demonstrations(tmp_path: Path):
    toy = toy_experiment(tmp_path)
    data = dataclasses.replace(without_variation(toy.data), tasks=("lamp_on",))
    experiment = dataclasses.replace(toy, baseline=BehaviourCloningConfig(normalise="data"), data=data)
    tokenizer = tokenizer_of(toy.tokenizer, toy.model.language.vocab_size)
    fitted = open_training_data(experiment, tokenizer, BatchPart(0, 1, 2)).vector_scale
    assert fitted is not None

    episodes = [random_episode(seed, size=32) for seed in range(3)]
    low, high = np.array(toy.encoding.codec.low), np.array(toy.encoding.codec.high)
    away = np.concatenate([one.target_pose[..., :3] - one.pose[..., :3] for one in episodes])
    away = 2 * away.reshape(-1, 3) / (high - low)
    np.testing.assert_allclose(fitted.low[:3], away.min(axis=0), atol=1e-5)
    np.testing.assert_allclose(fitted.high[:3], away.max(axis=0), atol=1e-5)
    assert (fitted.low[9], fitted.high[9]) == (-1, 1)

    config = dataclasses.replace(experiment.policy, vector_scale=fitted)
    # Its last layers begin with zeros.
    variables = make_learner(config, tokenizer).initialise(jax.random.key(0))
    episode = episodes[0]
    frame = decode_frame(episode, 0)
    observation = jax.tree.map(lambda x: np.asarray(x)[None], Observation(frame.pictures, frame.robot))
    action = make_policy(config, variables, tokenizer).decide(observation, [episode.instruction], None).action
    middle = (away.min(axis=0) + away.max(axis=0)) / 2 * (high - low) / 2
    expected = np.clip(frame.robot.pose[0, :3] + middle, low, high)
    np.testing.assert_allclose(action.pose[0, 0, :3], expected, atol=1e-5)


def test_a_denoised_answer_stays_in_the_range_of_the_demonstrations():
    baseline = DP3Config(point_channels=(16,), feature=16, language_layers=0, channels=(16,), inference_steps=1)
    scale = VectorScale((0.1,) * 10, (0.2,) * 10)
    tokenizer = suite_tokenizer()
    config = PolicyConfig(small_encoding(), ModelConfig(), baseline=baseline, vector_scale=scale)
    variables = jax.tree.map(lambda x: 10 * x, make_learner(config, tokenizer).initialise(jax.random.key(0)))
    frame = decode_frame(random_episode(0, size=32), 0)
    arm = dataclasses.replace(frame.robot, pose=np.array([[0, 0, 1, 0, 0, 0, 1]], np.float32))
    observation = jax.tree.map(lambda x: np.asarray(x)[None], Observation(frame.pictures, arm))
    action = make_policy(config, variables, tokenizer).decide(observation, ["turn the lamp on"], None).action
    codec = config.encoding.codec
    moved = (action.pose[0, 0, :3] - arm.pose[0, :3]) / ((np.array(codec.high) - np.array(codec.low)) / 2)
    assert np.all((moved >= 0.1 - 1e-6) & (moved <= 0.2 + 1e-6))
