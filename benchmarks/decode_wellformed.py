"""10,000 actions from random weights and hostile logits, each kind of vocabulary and arms: none malformed (10 minutes).

Usage: python -m benchmarks.decode_wellformed [--decodes 10000] [--choice greedy|expected|sample]
"""

import dataclasses
import sys
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from tqdm import tqdm

from dsvla_jax.command_line import configure_jax, fail_with_message
from dsvla_jax.encoding.grammar import AnswerGrammar, build_answer_grammar
from dsvla_jax.encoding.prompts import ParseFailure, Style, parse_answer
from dsvla_jax.encoding.text import Tokenizer
from dsvla_jax.model.config import LanguageConfig, ModelConfig, VisionConfig
from dsvla_jax.model.decode import Decoding, make_decoder
from dsvla_jax.model.vla import VLA, initialize
from dsvla_jax.types import ModelInputs, Text
from tests.vocabularies import small_tokenizer

BATCH, WIDTH = 250, 32
CASES: tuple[tuple[str, Style], ...] = (("words", "compact"), ("sentencepiece", "paper"), ("merged", "paper"))
HOSTILE = (np.nan, np.inf, -np.inf, 1e30, -1e30, 0.0)


@dataclasses.dataclass(frozen=True)
class Options:
    """How much to try."""

    decodes: int = 10_000
    """Of each vocabulary and number of arms."""
    choice: Literal["greedy", "expected", "sample"] = "greedy"


def attack(variables: Any, grammar: AnswerGrammar, trial: int, tokenizer: Tokenizer) -> Any:
    """Weights as they never should be: random and large, or with logits that ask for what is not allowed."""
    rng = np.random.default_rng(trial)
    weights = jax.tree.map(lambda x: np.asarray(x) * np.float32(rng.choice([1, 3, 30])), variables)
    output = weights["params"]["language"]["output"]
    kind = trial % 4
    if kind == 1:  # only the end, or a token of the template, wherever a number should be
        output[:, [tokenizer.eos_id, *rng.choice(grammar.templates[0] or (tokenizer.eos_id,), 1)]] = 1e6
    if kind == 2:  # every number as near to zeros as it goes, so that rotations of zeros are asked for
        for slot in grammar.slots:
            output[:, slot.tokens[-slot.low][-1]] = 1e6 * np.sign(rng.normal())
    if kind == 3:  # broken numbers
        output[:, rng.random(output.shape[1]) < rng.choice([0.1, 1.0])] = rng.choice(HOSTILE)
    return weights


def malformed(kind: str, style: Style, arms: int, options: Options) -> tuple[int, int, int]:
    """How many actions of how many were malformed, and how many different ones there were."""
    tokenizer = small_tokenizer(kind)
    language = LanguageConfig(vocab_size=tokenizer.vocab_size, width=WIDTH, layers=2, heads=4, kv_heads=2, ffn=48)
    config = ModelConfig(
        vision=VisionConfig(image_size=16, patch_size=8, width=WIDTH, layers=1, heads=4), language=language
    )
    grammar = build_answer_grammar(tokenizer, arms, style)
    decode = make_decoder(VLA(config), grammar, Decoding(options.choice))
    variables = jax.jit(lambda: initialize(config, jax.random.key(0)))()
    batches, failures, seen = -(-options.decodes // BATCH), 0, set()
    for trial in tqdm(range(batches), desc=f"{kind}, {arms} arm(s)", unit=f"{BATCH} actions"):
        rng = np.random.default_rng(trial)
        lengths = rng.integers(1, 10, BATCH)
        inputs = ModelInputs(
            images=jnp.asarray(rng.normal(size=(BATCH, 1, 16, 16, 3)), jnp.float32),
            point_tokens=jnp.asarray(rng.normal(size=(BATCH, 3, WIDTH)), jnp.float32),
            point_patches=jnp.asarray(rng.integers(0, 4, (BATCH, 3)), jnp.int32),
            text=Text(
                jnp.asarray(rng.integers(0, tokenizer.vocab_size, (BATCH, 9)), jnp.int32),
                jnp.arange(9)[None] < jnp.asarray(lengths)[:, None],
            ),
        )
        decoded = decode(attack(variables, grammar, trial, tokenizer), inputs, jax.random.key(trial))
        for integers in np.asarray(decoded.integers):
            try:
                text = tokenizer.decode(grammar.tokens(integers))
                failures += (parse_answer(text, arms, style) != integers).any()
            except (ParseFailure, IndexError):
                failures += 1
            seen.add(integers.tobytes())
    return int(failures), batches * BATCH, len(seen)


def main(options: Options) -> int:
    configure_jax()
    total = 0
    for kind, style in CASES:
        for arms in (1, 2):
            failures, decodes, different = malformed(kind, style, arms, options)
            print(
                f"{kind}, {arms} arm(s): {failures} of {decodes} malformed; {different} different actions", flush=True
            )
            total += failures
    return int(total > 0)


if __name__ == "__main__":
    with fail_with_message():
        sys.exit(main(tyro.cli(Options, description=__doc__)))
