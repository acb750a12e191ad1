"""A trained policy: Observation and instruction in, Action out. Evaluation and serving both use exactly this."""

import dataclasses
import json
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import cattrs
import jax
import jax.numpy as jnp
import numpy as np

from dsvla_jax.checkpoints import CheckpointError, RunCheckpoints
from dsvla_jax.encoding.codec import PoseCodec
from dsvla_jax.encoding.encode import EncodingConfig, build_prompt, encode_observation, encode_text
from dsvla_jax.encoding.prompts import parse_answer
from dsvla_jax.encoding.text import WordTokenizer, build_answer_grammar
from dsvla_jax.model.config import ModelConfig
from dsvla_jax.model.decode import decode_actions
from dsvla_jax.model.partition import shardings
from dsvla_jax.model.variables import Variables
from dsvla_jax.model.vla import VLA, initialize
from dsvla_jax.types import Action, Array, ModelInputs, Observation


@dataclasses.dataclass(frozen=True)
class PolicyConfig:
    """What inference needs to know of a run besides its weights and vocabulary."""

    encoding: EncodingConfig
    model: ModelConfig


@partial(jax.jit, static_argnames=("config", "tokenizer"))
def _decode(
    config: PolicyConfig,
    tokenizer: WordTokenizer,
    variables: Variables,
    observation: Observation,
    text_tokens: Array,
    text_mask: Array,
) -> Array:
    picture = encode_observation(observation, config.encoding)
    inputs = ModelInputs(**picture, text_tokens=text_tokens, text_mask=text_mask)
    grammar = build_answer_grammar(tokenizer, observation.pose.shape[1], config.encoding.style)
    return decode_actions(VLA(config.model), variables, inputs, grammar)[0]


@dataclasses.dataclass(frozen=True)
class Policy:
    """A policy ready to act. Build one with `load`."""

    config: PolicyConfig
    variables: Variables
    tokenizer: WordTokenizer

    @property
    def codec(self) -> PoseCodec:
        """From poses to bins and back."""
        return self.config.encoding.codec

    def encode_prompt(
        self, instruction: str, pose: np.ndarray, gripper_open: np.ndarray, keypoints: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """The question of one robot as tokens int32 (T,) and their mask bool (T,), see `encode_text`.

        pose: (A, 7). gripper_open: (A,). keypoints: (A, 3), the active ones, or None.
        Raises ValueError where the instruction is too long or has a number that no token stands for.
        """
        encoding = self.config.encoding
        prompt = build_prompt(encoding, instruction, pose, gripper_open, keypoints)
        return encode_text(self.tokenizer, prompt, None, encoding.max_text_length)[:2]

    def act(
        self, observation: Observation, instructions: Sequence[str], keypoints: np.ndarray | None
    ) -> tuple[Action, list[str]]:
        """The next key pose of every robot of a batch, and the answer texts that name it.

        observation: with a leading axis B; pose (B, A, 7). keypoints: float32 (B, A, 3), the active one of each arm,
        in metres and the world frame, or None. An answer is well-formed whatever the weights are.
        """
        poses, grippers = np.asarray(observation.pose), np.asarray(observation.gripper_open)
        encoded = [
            self.encode_prompt(text, poses[i], grippers[i], None if keypoints is None else keypoints[i])
            for i, text in enumerate(instructions)
        ]
        tokens, masks = (np.stack(column) for column in zip(*encoded, strict=True))
        answers = _decode(self.config, self.tokenizer, self.variables, observation, tokens, masks)
        texts = [self.tokenizer.decode([int(token) for token in row]) for row in np.asarray(answers)]
        bins = np.stack([parse_answer(text, poses.shape[1], self.config.encoding.style) for text in texts])
        return jax.vmap(self.codec.decode)(jnp.asarray(bins)), texts


def save_policy_config(run: Path, config: PolicyConfig, tokenizer: WordTokenizer) -> None:
    """Writes what `load` needs besides a checkpoint."""
    (run / "policy.json").write_text(json.dumps(dataclasses.asdict(config), indent=2) + "\n")
    tokenizer.save(run / "tokenizer.json")


def load_policy_config(run: Path) -> PolicyConfig:
    """What `save_policy_config` wrote. Raises CheckpointError where it did not, or for another version."""
    file = run / "policy.json"
    if not file.exists():
        raise CheckpointError(
            f"{run}: no run here (policy.json is missing); train one: python train.py CONFIG --run {run}"
        )
    try:
        return cattrs.Converter(forbid_extra_keys=True).structure(json.loads(file.read_text()), PolicyConfig)
    except (json.JSONDecodeError, cattrs.BaseValidationError) as error:
        raise CheckpointError(
            f"{file}: not a policy of this version of dsvla_jax ({error}); train the run again"
        ) from error


def load(run: Path, mesh: jax.sharding.Mesh | None = None) -> Policy:
    """The policy of a run folder, with the weights of its newest checkpoint, split over the mesh if there is one.

    Raises CheckpointError naming what is missing or does not fit.
    """
    config = load_policy_config(run)
    tokenizer = WordTokenizer.load(run / "tokenizer.json")
    like = jax.eval_shape(lambda: initialize(config.model, jax.random.key(0)))
    if mesh is not None:
        like = jax.tree.map(lambda leaf, where: leaf.update(sharding=where), like, shardings(like, mesh))
    checkpoints = RunCheckpoints(run)
    variables = checkpoints.restore_variables(like)
    checkpoints.close()
    return Policy(config, variables, tokenizer)
