"""A trained policy: Observation and instruction in, Action out. Evaluation and serving both use exactly this."""

import contextlib
import dataclasses
import json
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Float

from dsvla_jax.checkpoints.run import RunCheckpoints
from dsvla_jax.checkpoints.storage import CheckpointError
from dsvla_jax.config_files import read_config
from dsvla_jax.data_config import LearnedFrom
from dsvla_jax.encoding.codec import PoseCodec
from dsvla_jax.encoding.config import EncodingConfig
from dsvla_jax.encoding.displacement import DisplacementScale, displace
from dsvla_jax.encoding.encode import build_prompt, encode_text, model_inputs
from dsvla_jax.encoding.grammar import build_answer_grammar
from dsvla_jax.encoding.pretrained_tokenizers import fits_rows, load_tokenizer, save_tokenizer, vocabulary_digest
from dsvla_jax.encoding.prompts import format_answer
from dsvla_jax.encoding.text import Tokenizer, quoted, unknown_words
from dsvla_jax.errors import UserError
from dsvla_jax.json_values import Json
from dsvla_jax.model.config import ModelConfig
from dsvla_jax.model.decode import GREEDY, Decoded, Decoding, decode_actions
from dsvla_jax.model.partition import shardings
from dsvla_jax.model.same_sizes import require_same_sizes
from dsvla_jax.model.unstacked import unstack_layers
from dsvla_jax.model.variables import Variables
from dsvla_jax.model.vla import VLA, initialize
from dsvla_jax.types import Action, Array, Observation, RobotState, Text


@dataclasses.dataclass(frozen=True)
class PolicyConfig:
    """What inference needs to know of a run besides its weights and vocabulary."""

    encoding: EncodingConfig
    model: ModelConfig
    displacement: DisplacementScale | None = None
    """The range of answers that say where to go from the present pose; None for answers that are poses."""
    learned_from: LearnedFrom | None = None
    """None for runs of versions that did not keep it."""
    vocabulary: str | None = None
    """What `vocabulary_digest` gives for the run's vocabulary; None in runs from before it was written."""

    @property
    def wants_keypoints(self) -> bool:
        """Whether prompts state a keypoint, because those of training did."""
        seen = self.learned_from is None or self.learned_from.keypoints != "none"
        return self.encoding.use_keypoints and seen

    def __post_init__(self) -> None:
        require_same_sizes(self.encoding, self.model)


# Batches are filled up to one of these sizes, so that any size runs without compiling again; beyond, to a multiple of
# the last. Prompts are padded to a multiple of PROMPT_TOKENS.
BATCH_SIZES = (1, 2, 4, 8, 16, 25, 32, 50, 64, 100, 128)
PROMPT_TOKENS = 64


@struct.dataclass
class Decision:
    """What a policy decided for a batch.

    action: the next keyframes. texts: the answers that name them. log_probs, entropies: float32 (B, A, 8), of each
    number among those that its slot admits, and in nats of its slot's distribution: how sure the policy was.
    """

    action: Action
    texts: list[str] = struct.field(pytree_node=False)
    log_probs: np.ndarray
    entropies: np.ndarray


@partial(jax.jit, static_argnames=("config", "tokenizer", "decoding"))
def _decode(
    config: PolicyConfig,
    tokenizer: Tokenizer,
    decoding: Decoding,
    variables: Variables,
    observation: Observation[Array],
    text: Text[Array],
    key: Array | None,
) -> Decoded:
    inputs = model_inputs(observation.pictures, text, config.encoding)
    grammar = build_answer_grammar(tokenizer, observation.robot.pose.shape[1], config.encoding.style)
    return decode_actions(VLA(config.model), variables, inputs, grammar, decoding, key)


@dataclasses.dataclass(frozen=True)
class Policy:
    """A policy ready to act. Build one with `load_policy`."""

    config: PolicyConfig
    variables: Variables
    """The model's, or these from `unstack_layers`."""
    tokenizer: Tokenizer
    decoding: Decoding = GREEDY

    @property
    def codec(self) -> PoseCodec:
        """From poses to bins and back."""
        return self.config.encoding.codec

    def encode_prompt(
        self, instruction: str, robot: RobotState[np.ndarray], keypoints: Float[np.ndarray, "a 3"] | None
    ) -> Text[np.ndarray]:
        """Encodes the question of one robot; see `encode_text`.

        keypoints: the active one of each arm, metres, world frame, or None.
        Raises UserError if the instruction has a word or number that no token stands for, ValueError if it is too long.
        """
        if unknown := unknown_words([instruction], self.tokenizer):
            raise UserError(
                f"the policy's vocabulary has no token for {quoted(unknown)}; expected words that the policy "
                "was trained with"
            )
        encoding = self.config.encoding
        prompt = build_prompt(encoding, instruction, robot, keypoints)
        return encode_text(self.tokenizer, prompt, None, encoding.max_text_length)[0]

    def act(
        self, observation: Observation, instructions: Sequence[str], keypoints: np.ndarray | None
    ) -> tuple[Action, list[str]]:
        """The next keyframe of every robot of a batch, and the answer texts that name it; see `decide`."""
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
        """The next keyframe of every robot of a batch. It is well-formed whatever the weights are.

        observation: with a leading axis B of any size. keypoints: float32 (B, A, 3), the active one of
        each arm, in metres and the world frame, or None. key: for ``decoding`` that samples. prompt_tokens: the length
        to pad prompts to, which none may exceed; if not given, the next multiple of `PROMPT_TOKENS`.
        """
        size, robots = len(instructions), jax.tree.map(np.asarray, observation.robot)
        encoded = [
            self.encode_prompt(
                text, jax.tree.map(lambda x, i=i: x[i], robots), None if keypoints is None else keypoints[i]
            )
            for i, text in enumerate(instructions)
        ]
        text = jax.tree.map(lambda *rows: np.stack(rows), *encoded)
        longest = prompt_tokens or -(-int(text.mask.sum(axis=1).max()) // PROMPT_TOKENS) * PROMPT_TOKENS
        text = jax.tree.map(lambda x: x[:, :longest], text)
        if full_size(size) > size:
            # Others of the batch have no influence, so any will do to fill it up.
            rows = np.arange(full_size(size)) % size
            observation, text = jax.tree.map(lambda x: x[rows], (observation, text))
        decoded = _decode(self.config, self.tokenizer, self.decoding, self.variables, observation, text, key)
        bins, log_probs, entropies = (
            np.asarray(x)[:size] for x in (decoded.integers, decoded.log_probs, decoded.entropies)
        )
        texts = [format_answer(row, self.config.encoding.style) for row in bins]
        action = jax.vmap(self.codec.decode)(jnp.asarray(bins))
        if (scale := self.config.displacement) is not None:
            reached = displace(robots.pose, scale.from_pose(action.pose, self.codec))
            action = dataclasses.replace(action, pose=jnp.asarray(reached))
        return Decision(action, texts, log_probs, entropies)


def full_size(size: int) -> int:
    """The size to which a batch of ``size`` is filled up."""
    largest = BATCH_SIZES[-1]
    return next((full for full in BATCH_SIZES if full >= size), -(-size // largest) * largest)


def save_policy_config(run: Path, config: PolicyConfig, tokenizer: Tokenizer) -> None:
    """Writes what `load_policy` needs besides a checkpoint."""
    config = dataclasses.replace(config, vocabulary=vocabulary_digest(tokenizer))
    (run / "policy.json").write_text(json.dumps(dataclasses.asdict(config), indent=2) + "\n")
    save_tokenizer(tokenizer, run)


def load_policy_config(run: Path) -> PolicyConfig:
    """What `save_policy_config` wrote. Raises CheckpointError where it did not, or for another version."""
    file = run / "policy.json"
    if not file.exists():
        raise CheckpointError(
            f"{run}: no run here (policy.json is missing); train one: python train.py CONFIG --run {run}"
        )
    try:
        return read_config(file, PolicyConfig, "a policy", _name_cameras)
    except UserError as error:
        raise CheckpointError(f"{error}; train the run again") from error


def _name_cameras(fields: dict[str, Json]) -> None:
    """Turns the name of the only camera, which earlier versions kept, into names of cameras."""
    learned = fields.get("learned_from")
    if isinstance(learned, dict) and "camera" in learned:
        name = learned.pop("camera")
        learned["cameras"] = [name] if name else []


def load_vocabulary(run: Path, config: PolicyConfig) -> Tokenizer:
    """The vocabulary of a run folder. Raises CheckpointError where it is not the one that the run was trained with."""
    tokenizer, rows = load_tokenizer(run), config.model.language.vocab_size
    if not fits_rows(tokenizer, rows) or config.vocabulary not in (None, vocabulary_digest(tokenizer)):
        raise CheckpointError(
            f"{run}: its tokenizer files are not those that it was trained with: {tokenizer.vocab_size} tokens for an "
            f"embedding of {rows} rows, or other tokens, or in another order; copy them from the original run folder"
        )
    return tokenizer


def load_policy(
    run: Path,
    mesh: jax.sharding.Mesh | None = None,
    decoding: Decoding = GREEDY,
    step: int | Literal["best"] | None = None,
) -> Policy:
    """The policy of a run folder, split over the mesh if there is one.

    step: the checkpoint whose weights it gets: a number, "best" by its score, or the newest if not given.
    Raises CheckpointError naming what is missing or does not fit.
    """
    config = load_policy_config(run)
    tokenizer = load_vocabulary(run, config)
    like = jax.eval_shape(lambda: initialize(config.model, jax.random.key(0)))
    if mesh is not None:
        like = jax.tree.map(lambda leaf, where: leaf.update(sharding=where), like, shardings(like, mesh))
    with contextlib.closing(RunCheckpoints(run, read_only=True)) as checkpoints:
        variables = checkpoints.restore_variables(like, step)
    if mesh is None and jax.default_backend() == "cpu":
        variables = unstack_layers(variables)
    return Policy(config, variables, tokenizer, decoding)
