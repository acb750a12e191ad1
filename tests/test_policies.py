"""Policies that answer with poses: their vectors, diffusion, inputs, and how they learn and act."""

import contextlib
import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from data_pipelines.augment import shift_world
from data_pipelines.pose_samples import make_pose_sampler
from data_pipelines.records import decode_frame
from dsvla_jax.checkpoints.run import RunCheckpoints
from dsvla_jax.data_config import DataConfig
from dsvla_jax.encoding.codec import PoseCodec
from dsvla_jax.encoding.text import WordTokenizer, vocabulary
from dsvla_jax.encoding.vector_scale import VectorScale
from dsvla_jax.errors import UserError
from dsvla_jax.experiment import Experiment, OptimizerConfig
from dsvla_jax.geometry.cameras import front_camera
from dsvla_jax.model.config import ModelConfig
from dsvla_jax.planner.planning import plan_decoding
from dsvla_jax.policies.config import Baseline, BehaviourCloningConfig, DP3Config, PolicyConfig
from dsvla_jax.policies.diffusion import add_noise, denoise, signal_shares
from dsvla_jax.policies.dp3 import Convolution, PointEncoder
from dsvla_jax.policies.pose_vectors import center, from_vectors, to_vectors
from dsvla_jax.policies.registry import make_learner, make_policy
from dsvla_jax.policy import load_policy, save_policy_config
from dsvla_jax.training.chips import CHIPS, Slice
from dsvla_jax.training.loop import arrays_of, state_of
from dsvla_jax.training.state import TrainState, average_with, initial_state, make_optimizer, make_train_step
from dsvla_jax.types import Observation, PoseExample
from tests.random_data import random_episode
from tests.run_folders import NO_NOTES
from tests.small import small_encoding, small_language, small_vision

CODEC = PoseCodec()
TOKENIZER = WordTokenizer(vocabulary(["do lamp_on number", "turn the lamp on"]))
ENCODING = small_encoding(max_text_length=12, stride=1, workspace_low=(-3.0,) * 3, workspace_high=(3.0,) * 3)
MODEL = ModelConfig(vision=small_vision(), language=small_language(TOKENIZER.vocab_size))
BASELINES = {
    "behaviour_cloning": BehaviourCloningConfig(hidden=64),
    "dp3": DP3Config(
        upcoming=2, point_channels=(16, 32), feature=32, language_layers=1, channels=(16, 32), inference_steps=5
    ),
    "dp3_that_looks_back": DP3Config(
        look_back=2, point_channels=(16,), feature=16, language_layers=0, channels=(16,), inference_steps=2
    ),
}


def poses(rng: np.random.Generator, *shape: int) -> np.ndarray:
    """Random poses inside the box, with canonical quaternions."""
    place = rng.uniform(CODEC.low, CODEC.high, (*shape, 3))
    turn = Rotation.from_quat(rng.normal(size=(int(np.prod(shape)), 4))).as_quat(canonical=True).reshape(*shape, 4)
    return np.concatenate([place, turn], axis=-1).astype(np.float32)


def example(rng: np.random.Generator, count: int, arms: int = 1, upcoming: int = 1) -> PoseExample[np.ndarray]:
    """A batch of examples of random frames."""
    sample = make_pose_sampler(DataConfig(keypoint_noise=0.0), TOKENIZER, 12, True, upcoming)
    camera = jax.tree.map(lambda x: np.asarray(x)[None], front_camera(32))
    examples = []
    for number in range(count):
        frame = decode_frame(random_episode(number, arms=arms, frames=2, size=32), 0)
        turn, goal = poses(rng, arms), poses(rng, arms)
        frame = dataclasses.replace(
            frame,
            pictures=dataclasses.replace(frame.pictures, camera=camera),
            robot=dataclasses.replace(frame.robot, pose=turn),
            target=dataclasses.replace(frame.target, pose=goal),
            later=None,
            instruction="turn the lamp on",
        )
        examples.append(sample(frame, rng))
    return jax.tree.map(lambda *leaves: np.stack(leaves), *examples)


def test_vectors_hold_the_first_two_columns_of_the_rotation_and_lead_back():
    rng = np.random.default_rng(0)
    pose, gripper = poses(rng, 50), rng.integers(0, 2, 50).astype(np.float32)
    vectors = np.asarray(to_vectors(jnp.asarray(pose), jnp.asarray(gripper), center(CODEC), CODEC))
    matrix = Rotation.from_quat(pose[:, 3:]).as_matrix()
    np.testing.assert_allclose(vectors[:, 3:6], matrix[:, :, 0], atol=1e-5)
    np.testing.assert_allclose(vectors[:, 6:9], matrix[:, :, 1], atol=1e-5)
    np.testing.assert_allclose(vectors[:, :3], pose[:, :3] - [0, 0, 1], atol=1e-5)  # a box of 2 m around (0, 0, 1)
    back = from_vectors(jnp.asarray(vectors), center(CODEC), CODEC)
    np.testing.assert_allclose(back.pose[:, :3], pose[:, :3], atol=1e-5)
    turned = Rotation.from_quat(np.asarray(back.pose)[:, 3:]) * Rotation.from_quat(pose[:, 3:]).inv()
    assert turned.magnitude().max() < 1e-3
    np.testing.assert_array_equal(back.gripper_open, gripper)


def test_any_vector_is_a_keyframe_in_the_box():
    action = from_vectors(jax.random.normal(jax.random.key(0), (100, 10)) * 3, center(CODEC), CODEC)
    np.testing.assert_allclose(np.linalg.norm(action.pose[:, 3:], axis=-1), 1, atol=1e-4)
    assert np.all((action.pose[:, :3] >= np.array(CODEC.low)) & (action.pose[:, :3] <= np.array(CODEC.high)))
    assert set(np.unique(action.gripper_open)) <= {0.0, 1.0}


def test_the_schedule_ends_in_noise_and_follows_the_squared_cosine():
    shares = signal_shares(100)
    assert np.sqrt(shares[-1]) < 0.01
    curve = np.cos((np.arange(101) / 100 + 0.008) / 1.008 * np.pi / 2) ** 2
    np.testing.assert_allclose(shares[:-1], (curve[1:] / curve[0])[:-1], rtol=1e-4)


@pytest.mark.parametrize("steps", [1, 10, 100])
def test_denoising_with_the_right_answers_reaches_them(steps: int):
    clean = jnp.asarray(np.random.default_rng(0).uniform(-0.9, 0.9, (3, 4, 5)), jnp.float32)
    shares, noise = signal_shares(100), jax.random.normal(jax.random.key(0), clean.shape)
    np.testing.assert_allclose(denoise(lambda *_: clean, noise, shares, steps), clean, atol=1e-5)

    def from_noise(noisy: jax.Array, level: jax.Array) -> jax.Array:
        """Undoes `add_noise` of this noise: every step must lie on the line between it and the answer."""
        share = jnp.asarray(shares)[level][:, None, None]
        return (noisy - jnp.sqrt(1 - share) * noise) / jnp.sqrt(share)

    last = jnp.full(3, 99)
    start = add_noise(clean, noise, last, shares)
    np.testing.assert_allclose(denoise(from_noise, start, shares, steps), clean, atol=2e-2)


def test_an_example_holds_two_arms_and_the_keyframes_that_follow():
    episode = random_episode(3, arms=1, frames=4, size=32)
    sample = make_pose_sampler(DataConfig(keypoint_noise=0.0), TOKENIZER, 12, True, 3)
    one = sample(decode_frame(episode, 2), np.random.default_rng(0))
    np.testing.assert_array_equal(one.pose[:, 0], episode.target_pose[[2, 3, 3], 0])
    assert not one.pose[:, 1].any()
    np.testing.assert_array_equal(one.inputs.arms, [True, False])
    np.testing.assert_array_equal(one.inputs.keypoints[0], episode.active_keypoint[2, 0])
    assert one.inputs.words.mask.sum() == 1 + len(TOKENIZER.encode(episode.instruction))
    blind = make_pose_sampler(DataConfig(), TOKENIZER, 12, False, 3)(decode_frame(episode, 2), np.random.default_rng(0))
    assert not blind.inputs.has_keypoints
    assert not blind.inputs.keypoints.any()
    with pytest.raises(UserError, match="max_text_length 2; raise it"):
        make_pose_sampler(DataConfig(), TOKENIZER, 2, True, 1)(decode_frame(episode, 0), np.random.default_rng(0))


def test_a_shifted_world_moves_the_later_keyframes_too():
    frame = decode_frame(random_episode(3, arms=2, frames=3, size=32), 0)
    moved = shift_world(frame, np.array([0.1, -0.2, 0.0]))
    assert frame.later is not None
    assert moved.later is not None
    np.testing.assert_allclose(
        moved.later.pose[..., :3] - frame.later.pose[..., :3], [[[0.1, -0.2, 0]] * 2] * 2, atol=1e-6
    )
    np.testing.assert_array_equal(moved.later.pose[..., 3:], frame.later.pose[..., 3:])


def learner(baseline: Baseline, scale: VectorScale | None = None) -> Any:
    return make_learner(PolicyConfig(ENCODING, MODEL, baseline=baseline, vector_scale=scale), TOKENIZER)


@pytest.mark.parametrize("name", BASELINES)
def test_a_missing_arm_changes_no_loss_and_parts_add_up(name: str):
    baseline = BASELINES[name]
    policy, batch = learner(baseline), example(np.random.default_rng(0), 4, upcoming=baseline.upcoming)
    assert jax.tree.structure(policy.example_spec(4, 1, 32, 32)) == jax.tree.structure(batch)
    for spec, leaf in zip(jax.tree.leaves(policy.example_spec(4, 1, 32, 32)), jax.tree.leaves(batch), strict=True):
        assert (spec.shape, spec.dtype) == (leaf.shape, leaf.dtype)
    variables = policy.initialise(jax.random.key(0))
    totals, key = policy.totals(batch), jax.random.key(1)
    loss = jax.jit(lambda batch: policy.loss(variables, batch, totals, key)[0])
    other = dataclasses.replace(batch, pose=batch.pose.copy())
    other.pose[:, :, 1] = 5.0
    assert loss(other) == loss(batch)
    halves = [jax.tree.map(lambda leaf, half=half: leaf[half::2], batch) for half in range(2)]
    if name == "behaviour_cloning":  # noise is drawn for a batch, not for an example
        np.testing.assert_allclose(sum(loss(half) for half in halves), loss(batch), rtol=1e-5)


@pytest.mark.parametrize("name", BASELINES)
def test_a_policy_answers_the_same_in_any_company_and_always(name: str):
    variables = jax.tree.map(lambda x: 1.5 * x, learner(BASELINES[name]).initialise(jax.random.key(0)))
    policy = make_policy(PolicyConfig(ENCODING, MODEL, baseline=BASELINES[name]), variables, TOKENIZER)
    batch = example(np.random.default_rng(0), 3)
    robot = dataclasses.replace(
        batch.inputs.robot, pose=batch.inputs.robot.pose[:, :1], gripper_open=batch.inputs.robot.gripper_open[:, :1]
    )
    observation, near = Observation(batch.inputs.pictures, robot), batch.inputs.keypoints[:, :1]
    decision = policy.decide(observation, ["turn the lamp on"] * 3, near)
    again = policy.decide(observation, ["turn the lamp on"] * 3, near)
    np.testing.assert_array_equal(decision.action.pose, again.action.pose)
    assert decision.action.pose.shape == (3, 1, 7)
    assert [len(text.split()) for text in decision.texts] == [8] * 3
    alone = policy.decide(jax.tree.map(lambda x: x[1:2], observation), ["turn the lamp on"], near[1:2])
    np.testing.assert_allclose(alone.action.pose[0], decision.action.pose[1], atol=1e-4)
    on_device = policy.on_device(1, ["turn the lamp on"])
    question = on_device.ask(["turn the lamp on"] * 3)
    traced = jax.jit(on_device.act)(variables, jax.tree.map(jnp.asarray, observation), question, jnp.asarray(near))
    np.testing.assert_allclose(traced[0].pose, decision.action.pose, atol=1e-4)
    assert on_device.texts(traced[1]) == decision.texts
    with pytest.raises(UserError, match="no token for 'xyzzy'"):
        policy.decide(observation, ["xyzzy"] * 3, near)


@pytest.mark.parametrize("name", BASELINES)
def test_one_action_is_planned_as_it_is_counted(name: str):
    experiment = Experiment(
        encoding=ENCODING,
        model=MODEL if name == "behaviour_cloning" else ModelConfig(),
        baseline=BASELINES[name],
        data=DataConfig(image_size=32),
    )
    where = Slice("one processor", CHIPS["v5e"], tuple(jax.devices()[:1]), virtual=True)
    plan = plan_decoding(experiment, where, 2)
    assert plan.flops == pytest.approx(plan.counted_flops, rel=0.05)


def test_the_points_order_does_not_matter_to_dp3():
    points = jax.random.normal(jax.random.key(0), (2, 40, 6))
    encoder = PointEncoder((16, 32), 8)
    variables = encoder.init(jax.random.key(1), points)
    shuffled = points[:, jax.random.permutation(jax.random.key(2), 40)]
    one, other = (np.asarray(encoder.apply(variables, x)) for x in (points, shuffled))
    np.testing.assert_allclose(one, other, atol=1e-6)


@pytest.mark.parametrize("length", [1, 2, 4, 7])
@pytest.mark.parametrize(("kernel", "stride"), [(5, 1), (3, 1), (3, 2)])
def test_a_convolution_over_few_keyframes_is_xlas(length: int, kernel: int, stride: int):
    x = jax.random.normal(jax.random.key(0), (3, length, 4))
    convolution = Convolution(6, kernel, stride)
    variables = convolution.init(jax.random.key(1), x)
    weights = jnp.asarray(variables["params"]["kernel"])
    padding, order = [(kernel // 2, kernel // 2)], ("NWC", "WIO", "NWC")
    expected = jax.lax.conv_general_dilated(x, weights, (stride,), padding, dimension_numbers=order)
    np.testing.assert_allclose(np.asarray(convolution.apply(variables, x)), expected, atol=1e-5)


def train(baseline: Baseline, batch: PoseExample[np.ndarray], steps: int, rate: float) -> tuple[Any, TrainState]:
    """Trains on one batch over and over."""
    policy, optimizer = learner(baseline), make_optimizer(OptimizerConfig(learning_rate=rate, weight_decay=0.0), steps)
    state, frozen = initial_state(policy, optimizer, 0, "full", jnp.dtype(jnp.float32), average=True)
    step = jax.jit(make_train_step(policy, optimizer, average_decay=0.99), donate_argnums=0)
    for _ in range(steps):
        state, _ = step(state, frozen, batch)
    return policy, state


@pytest.mark.slow
@pytest.mark.parametrize("name", BASELINES)
def test_a_policy_overfits_eight_frames(name: str):
    baseline: Any = dataclasses.replace(BASELINES[name], upcoming=1)
    if name == "dp3":
        baseline = dataclasses.replace(baseline, channels=(64, 128), feature=64)
    batch = example(np.random.default_rng(0), 8)
    steps = 300 if name == "behaviour_cloning" else 1500
    policy, state = train(baseline, batch, steps, 3e-3)
    errors = {
        name: value / count for name, (value, count) in policy.errors(state.acting, batch, jax.random.key(0)).items()
    }
    assert errors["position_cm"] < 1
    assert errors["rotation_degrees"] < 3
    assert errors["gripper"] == 1


def test_the_average_follows_the_weights_by_its_decay():
    state = average_with({"w": jnp.zeros(2)}, {"w": jnp.ones(2)}, jnp.int32(0), 0.9)
    np.testing.assert_allclose(state["w"], 1, err_msg="after the first step it is the weights themselves")
    late = average_with({"w": jnp.zeros(2)}, {"w": jnp.ones(2)}, jnp.int32(10**6), 0.9)
    np.testing.assert_allclose(late["w"], 0.1, rtol=1e-5)
    middle = average_with({"w": jnp.zeros(2)}, {"w": jnp.ones(2)}, jnp.int32(15), 0.9)
    np.testing.assert_allclose(middle["w"], 16**-0.75, rtol=1e-5)


def test_settings_that_a_network_of_its_own_would_ignore_are_refused():
    plain = Experiment(encoding=ENCODING, baseline=DP3Config())
    for change, message in (
        ({"model": dataclasses.replace(ModelConfig(), cameras=2)}, "model.cameras: expected no such option for dp3"),
        ({"base": "runs/x"}, "base: expected no such option for dp3"),
        ({"soft_target_sigma": 1.0}, "soft_target_sigma: expected 0 for a policy that answers with poses"),
        ({"encoding": dataclasses.replace(ENCODING, use_points=False)}, "encoding.use_points: expected true for dp3"),
    ):
        with pytest.raises(UserError, match=message):
            dataclasses.replace(plain, **change)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"channels": ()}, "baseline.channels: expected multiples of 8, one or more"),
        ({"channels": (64, 63)}, "baseline.channels: expected multiples of 8"),
        ({"point_channels": ()}, "baseline.point_channels: expected one number or more"),
        ({"feature": 7}, "baseline.feature: expected a multiple of 4, got 7"),
        ({"inference_steps": 101}, "baseline.inference_steps: expected at least 1, at most 100, got 101"),
    ],
)
def test_sizes_that_no_network_can_have_are_refused(change: dict, message: str):
    with pytest.raises(UserError, match=message):
        DP3Config(**change)


def test_a_checkpoint_keeps_the_average_and_a_policy_acts_by_it(tmp_path: Path):
    baseline = BASELINES["behaviour_cloning"]
    policy, optimizer = learner(baseline), make_optimizer(OptimizerConfig(), 4)
    state, _ = initial_state(policy, optimizer, 0, "full", jnp.dtype(jnp.float32), average=True)
    state = dataclasses.replace(state, average=jax.tree.map(lambda x: x + 1, state.trainable))
    save_policy_config(tmp_path, PolicyConfig(ENCODING, MODEL, baseline=baseline), TOKENIZER)
    with contextlib.closing(RunCheckpoints(tmp_path)) as checkpoints:
        checkpoints.save(1, arrays_of(state), NO_NOTES)
        checkpoints.wait()
        restored = state_of(checkpoints.restore(arrays_of(state)))
    jax.tree.map(np.testing.assert_array_equal, restored.average, state.average)
    jax.tree.map(np.testing.assert_array_equal, restored.trainable, state.trainable)
    jax.tree.map(np.testing.assert_array_equal, load_policy(tmp_path).variables, state.average)
