"""Policies that answer with poses: how they learn and act, whatever their network."""

import dataclasses
import math
from collections.abc import Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from dsvla_jax.encoding.config import EncodingConfig
from dsvla_jax.encoding.pose_inputs import encode_instruction, pose_example_spec, pose_inputs
from dsvla_jax.encoding.prompts import format_answer
from dsvla_jax.encoding.text import Tokenizer, require_known_words
from dsvla_jax.geometry.rotations import rotation_distance
from dsvla_jax.model.variables import Regime, Variables
from dsvla_jax.policies.config import PolicyConfig
from dsvla_jax.policies.interface import Decision, Metrics, filled_up
from dsvla_jax.policies.networks import make_network, vector_space
from dsvla_jax.policies.pose_network import PoseNetwork, Vectors
from dsvla_jax.policies.pose_vectors import VectorSpace
from dsvla_jax.policies.traced_flops import product_flops
from dsvla_jax.types import Action, Array, Observation, PoseExample, PoseInputs, RobotState, Text

# Of the answers that `PoseLearner.errors` samples, and of those that a policy acts by, so that an observation has one
# answer.
ANSWER_SEED = 0


@dataclasses.dataclass(frozen=True)
class PoseLearner:
    """How they learn. See `Learner`."""

    network: PoseNetwork
    encoding: EncodingConfig
    space: VectorSpace
    cameras: int = 1
    """C, in its examples."""

    progress = ("position_cm", "position cm")

    def initialise(self, key: Array) -> Variables:
        """See `Learner`."""
        return self.network.initialise(key)

    def totals(self, batch: PoseExample[Array]) -> tuple[Array, ...]:
        """See `Learner`: the arms of a batch."""
        return (jnp.maximum(batch.inputs.arms.sum(), 1),)

    def loss(
        self, variables: Variables, part: PoseExample[Array], totals: tuple[Array, ...], key: Array
    ) -> tuple[Array, Metrics]:
        """See `Learner`. Where answers cost nothing, their errors are among the metrics."""
        (count,), there = totals, part.inputs.arms
        target = target_vectors(part, self.space)
        losses, vectors = self.network.losses(variables, part.inputs, target, key)
        loss = jnp.where(there, losses, 0).sum() / count
        metrics = {} if vectors is None else answer_errors(vectors, part, self.space)
        return loss, {"loss": loss, **{name: jnp.where(there, x, 0).sum() / count for name, x in metrics.items()}}

    def errors(self, variables: Variables, batch: PoseExample[Array], key: Array) -> dict[str, tuple[Array, Array]]:
        """See `Learner`."""
        there = batch.inputs.arms
        target = target_vectors(batch, self.space)
        losses, vectors = self.network.losses(variables, batch.inputs, target, key)
        if vectors is None:
            vectors = self.network.answer(variables, batch.inputs, jax.random.key(ANSWER_SEED))
        errors = {"loss": losses, **answer_errors(vectors, batch, self.space)}
        return {name: (jnp.where(there, error, 0).sum(), there.sum()) for name, error in errors.items()}

    def tokens(self, batch: PoseExample) -> int:
        """See `Learner`."""
        return int(batch.inputs.words.mask.sum())

    def flops(self, regime: Regime) -> int:
        """See `Learner`: counted in the traced gradient, in which everything learns."""
        encoding = self.encoding
        side = max(encoding.image_size, encoding.stride * math.ceil(encoding.points.num_points**0.5))
        batch = self.example_spec(1, self.cameras, side, side)
        variables = jax.eval_shape(self.initialise, jax.random.key(0))

        def loss(variables: Variables, batch: PoseExample[Array]) -> Array:
            return self.loss(variables, batch, self.totals(batch), jax.random.key(0))[0]

        return product_flops(jax.make_jaxpr(jax.grad(loss))(variables, batch).jaxpr)

    def example_spec(self, batch: int, cameras: int, height: int, width: int) -> PoseExample[jax.ShapeDtypeStruct]:
        """See `Learner`."""
        return pose_example_spec(batch, cameras, height, width, self.encoding.max_text_length, self.network.upcoming)


def target_vectors(batch: PoseExample[Array], space: VectorSpace) -> Vectors:
    """What is learned: the keyframes that follow, from where each arm is."""
    return space.to_vectors(batch.pose, batch.gripper_open, batch.inputs.robot.pose[:, None, :, :3])


def first_keyframe(vectors: Vectors, inputs: PoseInputs[Array], space: VectorSpace) -> Action[Array]:
    """The keyframe to execute, of both arms."""
    return space.from_vectors(vectors[:, 0], inputs.robot.pose[..., :3])


def answer_errors(vectors: Vectors, batch: PoseExample[Array], space: VectorSpace) -> dict[str, Float[Array, "b 2"]]:
    """Compares the first keyframe of answers with the demonstration's, for each arm."""
    answer = first_keyframe(vectors, batch.inputs, space)
    pose, gripper = batch.pose[:, 0], batch.gripper_open[:, 0]
    return {
        "position_cm": 100 * jnp.linalg.norm(answer.pose[..., :3] - pose[..., :3], axis=-1),
        "rotation_degrees": jnp.degrees(rotation_distance(answer.pose[..., 3:], pose[..., 3:])),
        "gripper": (answer.gripper_open == gripper).astype(jnp.float32),
    }


@partial(jax.jit, static_argnames=("network", "space"))
def _act(
    network: PoseNetwork, space: VectorSpace, variables: Variables, inputs: PoseInputs[Array], key: Array
) -> Action:
    return first_keyframe(network.answer(variables, inputs, key), inputs, space)


@dataclasses.dataclass(frozen=True)
class PosePolicy:
    """Such a policy ready to act. See `Policy`."""

    config: PolicyConfig
    variables: Variables
    tokenizer: Tokenizer

    @property
    def network(self) -> PoseNetwork:
        """The network that answers."""
        return make_network(self.config, self.tokenizer)

    @property
    def space(self) -> VectorSpace:
        """What its vectors count in."""
        return vector_space(self.config)

    def encode_prompt(
        self, instruction: str, robot: RobotState[np.ndarray], keypoints: Float[np.ndarray, "a 3"] | None
    ) -> Text[np.ndarray]:
        """See `Policy`: the instruction; state and keypoints are read as numbers."""
        return jax.tree.map(lambda rows: rows[0], self.encode_words([instruction]))

    def encode_words(self, instructions: Sequence[str]) -> Text[np.ndarray]:
        """Encodes the instructions of a batch. Raises UserError as `encode_prompt` does."""
        for text in instructions:
            require_known_words(text, self.tokenizer)
        length = self.config.encoding.max_text_length
        encoded = [encode_instruction(self.tokenizer, text, length) for text in instructions]
        return jax.tree.map(lambda *rows: np.stack(rows), *encoded)

    def act(
        self, observation: Observation, instructions: Sequence[str], keypoints: np.ndarray | None
    ) -> tuple[Action, list[str]]:
        """See `Policy`."""
        decision = self.decide(observation, instructions, keypoints)
        return decision.action, decision.texts

    def decide(
        self,
        observation: Observation,
        instructions: Sequence[str],
        keypoints: np.ndarray | None,
        key: Array | None = None,
        prompt_tokens: int | None = None,
    ) -> Decision:
        """See `Policy`. key: for policies that sample; the same answer each time without one."""
        size, arms = len(instructions), observation.robot.pose.shape[1]
        robot = jax.tree.map(np.asarray, observation.robot)
        words = self.encode_words(instructions)
        near = None
        if keypoints is not None and self.config.wants_keypoints:
            near = np.asarray(keypoints, np.float32)
        inputs = pose_inputs(observation.pictures, robot, words, near, observation.past)
        key = jax.random.key(ANSWER_SEED) if key is None else key
        action = _act(self.network, self.space, self.variables, filled_up(inputs, size), key)
        action = Action(action.pose[:size, :arms], action.gripper_open[:size, :arms])
        return Decision(action, action_texts(action, self.config))

    def on_device(self, arms: int, instructions: Sequence[str]) -> "PoseOnDevice":
        """See `Policy`."""
        return PoseOnDevice(self, arms)


def action_texts(action: Action, config: PolicyConfig) -> list[str]:
    """Writes the actions of a batch as 3DS-VLA would."""
    integers = np.asarray(config.encoding.codec.encode(action))
    return [format_answer(row, config.encoding.style) for row in integers]


@dataclasses.dataclass(frozen=True)
class PoseOnDevice:
    """Such a policy inside a jitted loop. See `DevicePolicy`; an answer is its action."""

    policy: PosePolicy
    arms: int

    def ask(self, instructions: Sequence[str]) -> Text[Array]:
        """See `DevicePolicy`."""
        return jax.tree.map(jnp.asarray, self.policy.encode_words(instructions))

    def act(
        self,
        variables: Variables,
        observation: Observation[Array],
        question: Text[Array],
        keypoints: Float[Array, "b a 3"],
    ) -> tuple[Action[Array], Action[Array]]:
        """See `DevicePolicy`."""
        near = keypoints if self.policy.config.wants_keypoints else None
        inputs = pose_inputs(observation.pictures, observation.robot, question, near, observation.past)
        vectors = self.policy.network.answer(variables, inputs, jax.random.key(ANSWER_SEED))
        action = first_keyframe(vectors, inputs, self.policy.space)
        action = Action(action.pose[:, : self.arms], action.gripper_open[:, : self.arms])
        return action, action

    def texts(self, answers: Action) -> list[str]:
        """See `DevicePolicy`."""
        return action_texts(answers, self.policy.config)
