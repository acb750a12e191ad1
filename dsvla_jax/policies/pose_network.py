"""What a network of a policy that answers with poses must have, and how errors of its vectors become a loss."""

from typing import Protocol

import jax.numpy as jnp
from jaxtyping import Float

from dsvla_jax.model.variables import Variables
from dsvla_jax.policies.pose_vectors import VECTOR
from dsvla_jax.types import Array, PoseInputs

Vectors = Float[Array, "b u 2 10"]


class PoseNetwork(Protocol):
    """A network that gives the next U keyframes of two arms as vectors (`pose_vectors`)."""

    @property
    def upcoming(self) -> int:
        """U."""
        ...

    def initialise(self, key: Array) -> Variables:
        """Random variables."""
        ...

    def losses(
        self, variables: Variables, inputs: PoseInputs[Array], target: Vectors, key: Array
    ) -> tuple[Float[Array, "b 2"], Vectors | None]:
        """The loss of each arm, and the vectors that the network answers with where they cost nothing."""
        ...

    def answer(self, variables: Variables, inputs: PoseInputs[Array], key: Array) -> Vectors:
        """The vectors that the policy answers with. An example's do not depend on the others of its batch."""
        ...


def mean_over_arm(error: Vectors) -> Float[Array, "b 2"]:
    """The mean of each arm's errors over its upcoming keyframes and the numbers of its vectors."""
    return error.sum(axis=(1, 3)) / (error.shape[1] * VECTOR)


def weighted(error: Vectors, rotation: float, gripper: float) -> Vectors:
    """Errors with the rotation's and the gripper's numbers weighted; those of the position count as 1."""
    return error * jnp.array([1.0] * 3 + [rotation] * 6 + [gripper])
