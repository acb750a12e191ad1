"""The interface of policies: how one learns, how it acts on the host, and how it acts inside a jitted loop.

Training knows a `Learner`; evaluation on the host, serving and the demo know a `Policy`; the loop on the device knows a
`DevicePolicy`. `registry.py` makes them from a config.
"""

from collections.abc import Sequence
from typing import Protocol, TypeAlias, TypeVar

import jax
import numpy as np
from flax import struct
from jaxtyping import Float

from dsvla_jax.encoding.text import Tokenizer
from dsvla_jax.model.variables import Regime, Variables
from dsvla_jax.policies.config import PolicyConfig
from dsvla_jax.types import Action, Array, Observation, RobotState, Text

ExampleT = TypeVar("ExampleT", contravariant=True)
HeldOutT = TypeVar("HeldOutT", contravariant=True)
AnswerT = TypeVar("AnswerT")
QuestionT = TypeVar("QuestionT")
Tree = TypeVar("Tree")

Metrics: TypeAlias = dict[str, Array]
"""float32 () by name; which there are depends on the policy."""

# Batches are filled up to one of these sizes, so that any size runs without compiling again; beyond, to a multiple of
# the last.
BATCH_SIZES = (1, 2, 4, 8, 16, 25, 32, 50, 64, 100, 128)


class Learner(Protocol[ExampleT, HeldOutT]):
    """How a policy learns: pure functions of its variables, which the training step and validation are made of.

    ExampleT is what its training batches are, HeldOutT what its validation batches are.
    """

    @property
    def progress(self) -> tuple[str, str]:
        """The metric that the progress bar shows beside the loss, and its words."""
        ...

    def initialise(self, key: Array) -> Variables:
        """Random variables. Pure: may be jitted with shardings."""
        ...

    def totals(self, batch: ExampleT) -> tuple[Array, ...]:
        """Counts what the means of `loss` are taken over in a whole batch."""
        ...

    def loss(
        self, variables: Variables, part: ExampleT, totals: tuple[Array, ...], key: Array
    ) -> tuple[Array, Metrics]:
        """The loss of a part of a batch, and metrics by name, "loss" among them.

        totals: of the whole batch, so that the sums over its parts are the whole batch's loss and metrics.
        """
        ...

    def errors(self, variables: Variables, batch: HeldOutT, key: Array) -> dict[str, tuple[Array, Array]]:
        """Compares answers with held-out demonstrations: by name a figure's sum over the batch, and over how many.

        Every policy has "loss", "position_cm", "rotation_degrees" and "gripper" (the share that is right).
        """
        ...

    def tokens(self, batch: ExampleT) -> int:
        """How many text tokens a batch has."""
        ...

    def flops(self, regime: Regime) -> int:
        """Floating-point operations of matrix products of one example in one training step, without recomputation."""
        ...

    def example_spec(self, batch: int, cameras: int, height: int, width: int) -> object:
        """Shapes and dtypes of a training batch with pictures of (height, width) of so many cameras."""
        ...


@struct.dataclass
class Decision:
    """What a policy decided for a batch.

    action: the next keyframes. texts: the answers that name them. log_probs, entropies: float32 (B, A, 8), of each
    number among those that its slot admits, and in nats of its slot's distribution: how sure the policy was; None for
    policies that answer with poses.
    """

    action: Action
    texts: list[str] = struct.field(pytree_node=False)
    log_probs: np.ndarray | None = None
    entropies: np.ndarray | None = None


class DevicePolicy(Protocol[QuestionT, AnswerT]):
    """A policy for robots of one number of arms that acts inside a jitted function."""

    def ask(self, instructions: Sequence[str]) -> QuestionT:
        """On the host: what `act` needs of B instructions, as arrays of one shape for all instructions."""
        ...

    def act(
        self,
        variables: Variables,
        observation: Observation[Array],
        question: QuestionT,
        keypoints: Float[Array, "b a 3"],
    ) -> tuple[Action[Array], AnswerT]:
        """Traced: the next keyframes, and the answers that name them."""
        ...

    def texts(self, answers: AnswerT) -> list[str]:
        """On the host: B answers as text."""
        ...


class Policy(Protocol):
    """A policy with its weights, ready to act from the host. Build one with `dsvla_jax.policy.load_policy`."""

    @property
    def config(self) -> PolicyConfig:
        """What it is made of."""
        ...

    @property
    def variables(self) -> Variables:
        """Its weights."""
        ...

    @property
    def tokenizer(self) -> Tokenizer:
        """Its vocabulary."""
        ...

    def encode_prompt(
        self, instruction: str, robot: RobotState[np.ndarray], keypoints: Float[np.ndarray, "a 3"] | None
    ) -> Text[np.ndarray]:
        """Encodes what the language model of one robot reads.

        keypoints: the active one of each arm, metres, world frame, or None.
        Raises UserError if the instruction has a word or number that no token stands for, or is too long.
        """
        ...

    def decide(
        self,
        observation: Observation,
        instructions: Sequence[str],
        keypoints: np.ndarray | None,
        key: Array | None = None,
        prompt_tokens: int | None = None,
    ) -> Decision:
        """The next keyframe of every robot of a batch. It is well-formed whatever the weights are.

        observation: with a leading axis B of any size. keypoints: float32 (B, A, 3), the active one of each arm, in
        metres and the world frame, or None. key: for policies that sample. prompt_tokens: the length to pad prompts to,
        which none may exceed; if not given, one that compiles rarely.
        """
        ...

    def act(
        self, observation: Observation, instructions: Sequence[str], keypoints: np.ndarray | None
    ) -> tuple[Action, list[str]]:
        """The next keyframe of every robot of a batch, and the answer texts that name it; see `decide`."""
        ...

    def on_device(self, arms: int, instructions: Sequence[str]) -> DevicePolicy:
        """The policy inside a jitted loop, for robots with so many arms. instructions: all that it may be asked.

        Raises UserError for policies that act from the host alone.
        """
        ...


def full_size(size: int) -> int:
    """The size to which a batch of ``size`` is filled up."""
    largest = BATCH_SIZES[-1]
    return next((full for full in BATCH_SIZES if full >= size), -(-size // largest) * largest)


def filled_up(tree: Tree, size: int) -> Tree:
    """A batch of ``size`` filled up to its full size with others of it, which have no influence on an answer."""
    rows = np.arange(full_size(size)) % size
    return tree if len(rows) == size else jax.tree.map(lambda leaf: leaf[rows], tree)
