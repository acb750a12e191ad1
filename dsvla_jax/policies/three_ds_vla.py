"""3DS-VLA: reads a picture, 3D tokens and a prompt, and writes the next keyframe as text (the paper's policy)."""

import dataclasses
from collections.abc import Sequence
from functools import cached_property, partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from dsvla_jax.encoding.codec import PoseCodec
from dsvla_jax.encoding.config import EncodingConfig
from dsvla_jax.encoding.displacement import displace
from dsvla_jax.encoding.encode import build_prompt, encode_text, example_spec, model_inputs
from dsvla_jax.encoding.grammar import build_answer_grammar
from dsvla_jax.encoding.number_targets import NumberTargets, number_rows
from dsvla_jax.encoding.prompt_table import PromptTable, instruction_tokens, make_prompt_table, write_prompts
from dsvla_jax.encoding.prompts import format_answer
from dsvla_jax.encoding.text import Tokenizer, require_known_words
from dsvla_jax.errors import UserError
from dsvla_jax.model.config import ModelConfig
from dsvla_jax.model.decode import GREEDY, Decoded, Decoding, decode_actions
from dsvla_jax.model.flops import model_flops
from dsvla_jax.model.variables import Regime, Variables
from dsvla_jax.model.vla import VLA, initialize
from dsvla_jax.policies.answer_errors import guess_integers, number_errors
from dsvla_jax.policies.answer_loss import answer_counts, answer_loss
from dsvla_jax.policies.config import PolicyConfig
from dsvla_jax.policies.interface import Decision, Metrics, filled_up
from dsvla_jax.types import Action, Array, Example, HeldOutExample, Observation, RobotState, Text

# Prompts are padded to a multiple of it.
PROMPT_TOKENS = 64


@dataclasses.dataclass(frozen=True)
class TextLearner:
    """How 3DS-VLA learns: cross-entropy on the tokens of the answer. See `Learner`."""

    encoding: EncodingConfig
    model: ModelConfig
    targets: NumberTargets
    """What is learned at each token of a number."""
    number_values: np.ndarray | None = None
    """float32 (V,), see `initialize`."""

    progress = ("bin_within_one", "bins within one")

    def initialise(self, key: Array) -> Variables:
        """See `Learner`; tokens that are numbers begin near each other where their values are."""
        return initialize(self.model, key, self.number_values)

    def totals(self, batch: Example[Array]) -> tuple[Array, ...]:
        """See `Learner`."""
        return answer_counts(batch, self.targets)

    def logits(self, variables: Variables, example: Example[Array], key: Array) -> Float[Array, "b t v"]:
        """Predicts each token of a batch's texts from those before it. key: for dropout."""
        inputs = model_inputs(example.pictures, example.text, self.encoding)
        logits = VLA(self.model).apply(variables, inputs, rngs={"dropout": key})
        assert isinstance(logits, jax.Array)
        return logits

    def loss(
        self, variables: Variables, part: Example[Array], totals: tuple[Array, ...], key: Array
    ) -> tuple[Array, Metrics]:
        """See `Learner` and `answer_loss`."""
        tokens, bins = totals
        return answer_loss(self.logits(variables, part, key), part, self.targets, (tokens, bins))

    def errors(self, variables: Variables, batch: HeldOutExample[Array], key: Array) -> dict[str, tuple[Array, Array]]:
        """See `Learner`; also the shares of bins that are exact, and within one."""
        example, one = batch.example, jnp.ones((), jnp.int32)
        logits = self.logits(variables, example, key)
        loss, _ = answer_loss(logits, example, self.targets, (one, one))
        guess = guess_integers(logits, batch, self.targets)
        answered = example.answer_mask[:, 1:].sum()
        return {"loss": (loss, answered), **number_errors(guess, batch, self.encoding.codec)}

    def tokens(self, batch: Example) -> int:
        """See `Learner`."""
        return int(batch.text.mask.sum())

    def flops(self, regime: Regime) -> int:
        """See `Learner`."""
        return model_flops(self.encoding, self.model, regime)

    def example_spec(self, batch: int, cameras: int, height: int, width: int) -> Example[jax.ShapeDtypeStruct]:
        """See `Learner`."""
        return example_spec(self.encoding, batch, cameras, height, width)


def text_learner(
    encoding: EncodingConfig, model: ModelConfig, tokenizer: Tokenizer, soft_target_sigma: float = 0.0
) -> TextLearner:
    """Returns how 3DS-VLA learns with a vocabulary.

    soft_target_sigma: bins, the width of the Gaussian that replaces one-hot targets on numbers; 0 is the paper's
        cross-entropy.
    """
    values = tokenizer.number_values
    if values is not None:
        # An embedding may have more rows than its tokenizer has tokens.
        more = max(model.language.vocab_size - len(values), 0)
        values = np.pad(values, (0, more), constant_values=np.nan)
    targets = number_rows(tokenizer, encoding.style).targets(soft_target_sigma)
    return TextLearner(encoding, model, targets, values)


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
class TextPolicy:
    """3DS-VLA ready to act. See `Policy`."""

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
        """Encodes the question of one robot; see `Policy` and `encode_text`."""
        require_known_words(instruction, self.tokenizer)
        encoding = self.config.encoding
        prompt = build_prompt(encoding, instruction, robot, keypoints)
        return encode_text(self.tokenizer, prompt, None, encoding.max_text_length)[0]

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
        """See `Policy`. key: for ``decoding`` that samples. Prompts are padded to a multiple of `PROMPT_TOKENS`."""
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
        observation, text = filled_up((observation, text), size)
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

    def on_device(self, arms: int, instructions: Sequence[str]) -> "TextOnDevice":
        """See `Policy`. Raises UserError for answers that are displacements, and for decoding that samples."""
        if self.config.displacement is not None:
            raise UserError("loop: this policy answers with displacements; use the loop on the host: --loop host")
        if self.decoding.choice == "sample":
            raise UserError("loop: answers that are drawn need a key for each; use the loop on the host: --loop host")
        return TextOnDevice(self.config, self.tokenizer, self.decoding, arms, tuple(instructions))


@dataclasses.dataclass(frozen=True)
class TextOnDevice:
    """3DS-VLA inside a jitted loop. See `DevicePolicy`; an answer is its integers, int32 (B, A, 8)."""

    config: PolicyConfig
    tokenizer: Tokenizer
    decoding: Decoding
    arms: int
    instructions: tuple[str, ...]

    @cached_property
    def _table(self) -> PromptTable:
        return make_prompt_table(self.tokenizer, self.config.encoding, self.arms)

    @cached_property
    def _longest(self) -> int:
        return self._beginnings(self.instructions)[0].shape[1]

    def _beginnings(self, instructions: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
        return instruction_tokens(self.tokenizer, self.config.encoding, self.arms, list(instructions))

    def ask(self, instructions: Sequence[str]) -> tuple[Array, Array]:
        """See `DevicePolicy`: the tokens before the first number of each prompt, and how many they are."""
        beginnings, lengths = self._beginnings(instructions)
        beginnings = np.pad(beginnings, ((0, 0), (0, self._longest - beginnings.shape[1])))
        return jnp.asarray(beginnings), jnp.asarray(lengths)

    def act(
        self,
        variables: Variables,
        observation: Observation[Array],
        question: tuple[Array, Array],
        keypoints: Float[Array, "b a 3"],
    ) -> tuple[Action[Array], Array]:
        """See `DevicePolicy`."""
        encoding, robot, (beginnings, lengths) = self.config.encoding, observation.robot, question
        integers = encoding.codec.encode(robot.pose, robot.gripper_open).reshape(len(lengths), -1)
        if encoding.use_keypoints:
            near = encoding.codec.encode_position(keypoints).reshape(len(lengths), -1)
            integers = jnp.concatenate([integers, near], axis=1)
        size = self._longest + self._table.longest
        prompts = Text(*write_prompts(self._table, beginnings, lengths, integers, size, self.tokenizer.pad_id))
        inputs = model_inputs(observation.pictures, prompts, encoding)
        grammar = build_answer_grammar(self.tokenizer, self.arms, encoding.style)
        answer = decode_actions(VLA(self.config.model), variables, inputs, grammar, self.decoding, None).integers
        return encoding.codec.decode(answer), answer

    def texts(self, answers: Array | np.ndarray) -> list[str]:
        """See `DevicePolicy`."""
        return [format_answer(integers, self.config.encoding.style) for integers in np.asarray(answers)]
