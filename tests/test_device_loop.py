"""The closed loop on the device against the one on the host, both stepping MJX."""

import dataclasses

import jax
import numpy as np
import pytest

from dsvla_jax.encoding.displacement import DisplacementScale
from dsvla_jax.evaluation.device_loop import DeviceLoop
from dsvla_jax.evaluation.loop import run_episodes
from dsvla_jax.perception.simulator import SegmentationKeypoints
from dsvla_jax.policies.config import Baseline, BehaviourCloningConfig
from dsvla_jax.policies.interface import Policy
from dsvla_jax.policies.registry import make_learner, make_policy
from dsvla_jax.sim.environment import Environment
from dsvla_jax.sim.seeds import episode_keys
from tests.serving import SIZE, tiny_policy

# m. Poses pass through float32 sums of hundreds of terms, whose order is the compiler's: 3e-6 of a metre is one
# standard deviation of such a sum. No gripper can tell a hundredth of a millimetre.
ROUNDING = 1e-5


def random_policy(baseline: Baseline, plain: Policy) -> Policy:
    """A policy that answers with poses, with random weights, as large as another one."""
    config = dataclasses.replace(plain.config, baseline=baseline)
    learner = make_learner(config, plain.tokenizer)
    leaves, structure = jax.tree.flatten(learner.initialise(jax.random.key(0)))
    keys = jax.random.split(jax.random.key(1), len(leaves))
    # What begins at zero, such as the last layer, answers too.
    leaves = [x + 0.05 * jax.random.normal(key, x.shape) for x, key in zip(leaves, keys, strict=True)]
    variables = jax.tree.unflatten(structure, leaves)
    return make_policy(config, variables, plain.tokenizer)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["text", "poses"])
@pytest.mark.parametrize("cameras", [("front",), ("front", "wrist")])
def test_both_loops_give_the_same_episodes(kind: str, cameras: tuple[str, ...]):
    environment = Environment("lamp_on", "mjx", image_size=SIZE, cameras=cameras)
    words = environment.task.all_instructions()
    policy = tiny_policy(words=words, cameras=cameras)
    if kind == "poses":
        policy = random_policy(BehaviourCloningConfig(), policy)
    state = environment.reset(episode_keys(0, "validation", "lamp_on", 0, 3))
    source = SegmentationKeypoints(environment, state)
    found, problems = source(state, environment.observe(state))
    assert problems == [""] * 3
    noise = np.random.default_rng(0).uniform(-0.05, 0.05, found.shape)
    options = {"first": 2, "noise": noise, "find_keypoints": source}
    on_host = run_episodes(environment, policy.act, state, limit=3, **options)
    on_device = DeviceLoop(environment, policy, limit=3)(state, **options)
    for one, other in zip(on_host, on_device, strict=True):
        for field in ("success", "reason", "keyframes", "instruction", "answers"):
            assert getattr(one, field) == getattr(other, field)
        np.testing.assert_allclose(one.targets, other.targets, atol=ROUNDING)
        np.testing.assert_array_equal(one.views[-1].rgb, other.views[-1].rgb)
    assert len({answer for outcome in on_host for answer in outcome.answers}) > 1


def test_what_only_the_host_loop_can_do_is_refused():
    environment, policy = Environment("lamp_on", image_size=SIZE), tiny_policy()
    with pytest.raises(ValueError, match=r"expected Environment.*physics='mjx'"):
        DeviceLoop(environment, policy)
    config = dataclasses.replace(policy.config, displacement=DisplacementScale((-1.0,) * 6, (1.0,) * 6))
    with pytest.raises(ValueError, match=r"answers with displacements; use the loop on the host: --loop host"):
        DeviceLoop(environment, dataclasses.replace(policy, config=config))
