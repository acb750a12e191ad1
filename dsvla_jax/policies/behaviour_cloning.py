"""Behaviour cloning: 3DS-VLA's trunk with a head that gives the keyframe as numbers instead of text.

The trunk reads picture, 3D tokens and instruction; a network of two hidden layers reads the last token's hidden state
and the robot's own vector, and answers with absolute errors as its loss, as OpenVLA-OFT's head does (Kim et al. 2025,
"Fine-Tuning Vision-Language-Action Models", section IV). A linear path from the robot's vector to the answer lets a
position be given relative to the arm, or to its keypoint.
"""

import dataclasses
from typing import cast

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Float

from dsvla_jax.encoding.codec import PoseCodec
from dsvla_jax.encoding.config import EncodingConfig
from dsvla_jax.encoding.encode import model_inputs
from dsvla_jax.encoding.pose_inputs import ARMS
from dsvla_jax.model.config import ModelConfig
from dsvla_jax.model.quantize import quantize
from dsvla_jax.model.variables import Variables
from dsvla_jax.model.vla import VLA, blank_inputs
from dsvla_jax.policies.config import BehaviourCloningConfig
from dsvla_jax.policies.pose_network import Vectors, mean_over_arm, weighted
from dsvla_jax.policies.pose_vectors import VECTOR
from dsvla_jax.policies.robot_vector import robot_vector, robot_width, with_waves
from dsvla_jax.types import Array, ModelInputs, PoseInputs


class PoseHead(nn.Module):
    """Hidden state (B, width) and robot (B, R) -> vectors (B, U, 2, 10)."""

    upcoming: int
    hidden: int

    @nn.compact
    def __call__(self, hidden: Array, robot: Array) -> Vectors:
        """The vectors of the upcoming keyframes."""
        outputs = self.upcoming * ARMS * VECTOR
        x = jnp.concatenate([hidden.astype(jnp.float32), with_waves(robot)], axis=-1)
        for name in ("first", "second"):
            x = nn.gelu(nn.Dense(self.hidden, name=name)(x))
        answer = nn.Dense(outputs, name="out", kernel_init=nn.initializers.zeros_init())(x)
        answer += nn.Dense(outputs, name="direct", use_bias=False, kernel_init=nn.initializers.zeros_init())(robot)
        return answer.reshape(-1, self.upcoming, ARMS, VECTOR)


class PoseVLA(VLA):
    """The trunk with the head; `poses` instead of logits."""

    upcoming: int = 1
    head_width: int = 256

    def setup(self) -> None:
        """Makes the head beside the trunk."""
        super().setup()
        self.pose_head = PoseHead(self.upcoming, self.head_width)

    def poses(self, inputs: ModelInputs, robot: Array) -> Vectors:
        """Answers from the hidden state of each example's last valid token."""
        hidden = self.hidden(inputs)
        last = inputs.text.mask.sum(axis=1) - 1
        return self.pose_head(jnp.take_along_axis(hidden, last[:, None, None], axis=1)[:, 0], robot)


@dataclasses.dataclass(frozen=True)
class BehaviourCloning:
    """See `PoseNetwork`."""

    config: BehaviourCloningConfig
    encoding: EncodingConfig
    model: ModelConfig

    @property
    def upcoming(self) -> int:
        """See `PoseNetwork`."""
        return self.config.upcoming

    @property
    def _codec(self) -> PoseCodec:
        return self.encoding.codec

    @property
    def _network(self) -> PoseVLA:
        return PoseVLA(self.model, self.config.upcoming, self.config.hidden)

    def initialise(self, key: Array) -> Variables:
        """See `PoseNetwork`."""
        blank = blank_inputs(self.model)
        robot = jnp.zeros((1, robot_width()))
        variables = dict(jax.jit(lambda key: self._network.init(key, blank, robot, method=PoseVLA.poses))(key))
        if self.model.base_dtype == "int8":
            variables["params"] = quantize(variables["params"])
        return variables

    def _poses(self, variables: Variables, inputs: PoseInputs[Array], key: Array) -> Vectors:
        read = model_inputs(inputs.pictures, inputs.words, self.encoding)
        robot = robot_vector(inputs, self._codec)
        poses = self._network.apply(variables, read, robot, method=PoseVLA.poses, rngs={"dropout": key})
        return cast(Vectors, poses)

    def losses(
        self, variables: Variables, inputs: PoseInputs[Array], target: Vectors, key: Array
    ) -> tuple[Float[Array, "b 2"], Vectors | None]:
        """See `PoseNetwork`: absolute errors."""
        poses = self._poses(variables, inputs, key)
        weights = (self.config.rotation_weight, self.config.gripper_weight)
        return mean_over_arm(weighted(jnp.abs(poses - target), *weights)), poses

    def answer(self, variables: Variables, inputs: PoseInputs[Array], key: Array) -> Vectors:
        """See `PoseNetwork`."""
        return self._poses(variables, inputs, key)
