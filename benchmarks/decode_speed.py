"""An action is >= 2.5x quicker than with transformers.generate, same 110 M LLaMA (5 minutes; needs the extra parity).

Usage: python -m benchmarks.decode_speed [--tokenizer FOLDER] [--repeats 7] [--limit 2.5]

Both read the same two visual tokens and the same prompt of a single arm with the same random weights in float32, on all
cores, by turns; transformers decodes greedily with its key/value cache for as many tokens as the answer has. The
log-probabilities of the decoder's choices are compared with those of transformers' logits, too. Without --tokenizer a
small vocabulary that splits digits, as LLaMA's does, stands in (benchmarks.llama_tokens --out makes LLaMA's). Exits
with 77 where torch and transformers are not installed.
"""

import dataclasses
import os
import statistics
import sys
import tempfile
import time
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from dsvla_jax.command_line import fail_with_message
from dsvla_jax.encoding.encode import encode_text
from dsvla_jax.encoding.grammar import AnswerGrammar, build_answer_grammar
from dsvla_jax.encoding.pretrained_tokenizers import load_tokenizer
from dsvla_jax.encoding.prompts import format_prompt
from dsvla_jax.model.config import LanguageConfig, ModelConfig, VisionConfig
from dsvla_jax.model.decode import make_decoder
from dsvla_jax.model.unstacked import unstack_layers
from dsvla_jax.model.vla import VLA, initialize
from dsvla_jax.types import ModelInputs
from dsvla_jax.weights.backbones import import_backbones, load_backbones
from dsvla_jax.weights.writers.hugging_face import language_json
from tests.decoding import log_probability
from tests.vocabularies import small_tokenizer

LANGUAGE = LanguageConfig(vocab_size=32000, width=768, layers=12, heads=12, kv_heads=12, ffn=2048, tie_embeddings=True)
STATE = np.array([[28, -1, 140, 0, 100, 0, 0, 1]])
KEYPOINT = np.array([[25, 3, 80]])
UNAVAILABLE = 77


@dataclasses.dataclass(frozen=True)
class Options:
    """What to compare."""

    tokenizer: Path | None = None
    """A tokenizer's folder."""
    repeats: int = 7
    limit: float = 2.5
    """Exit with 1 if transformers is not so many times slower."""


def cores() -> int:
    """What both may use; fewer than the machine has under taskset."""
    return len(os.sched_getaffinity(0))


def their_model() -> Any:
    """A random LLaMA of transformers."""
    import torch  # pyright: ignore[reportMissingImports]
    import transformers  # pyright: ignore[reportMissingImports]

    torch.set_num_threads(cores())
    torch.manual_seed(0)
    config = transformers.LlamaConfig(**language_json(LANGUAGE, "float32"), initializer_range=0.05)
    return transformers.LlamaForCausalLM(config).eval()


def our_variables(model: Any, config: ModelConfig) -> Any:
    """Variables with the weights of transformers' model in the language tower."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        model.save_pretrained(folder / "source")
        import_backbones(folder / "source", folder / "base")
        language = load_backbones(folder / "base")["params"]["language"]
    shapes = jax.eval_shape(lambda: initialize(config, jax.random.key(0)))
    rng = np.random.default_rng(0)
    params = jax.tree.map(lambda leaf: rng.normal(0, 0.1, leaf.shape).astype(np.float32), shapes["params"])
    return jax.device_put({"params": {**params, "language": language}})


def largest_difference(model: Any, embeddings: np.ndarray, grammar: AnswerGrammar, decoded: Any) -> float:
    """Between the log-probabilities of the decoder's choices and those of transformers' logits."""
    import torch  # pyright: ignore[reportMissingImports]

    integers = np.asarray(decoded.integers[0])
    answer = torch.tensor([grammar.tokens(integers)])
    with torch.no_grad():
        inputs = torch.cat([torch.from_numpy(embeddings), model.get_input_embeddings()(answer)], dim=1)
        logits = model(inputs_embeds=inputs).logits[0].double().numpy()
    place, differences = embeddings.shape[1] - 1 + len(grammar.templates[0]), []
    for index, (value, slot) in enumerate(zip(integers.ravel(), grammar.slots, strict=True)):
        tokens = slot.tokens[value - slot.low]
        theirs = log_probability(slot, tokens, logits[place:])
        differences.append(abs(theirs - float(decoded.log_probs[0].ravel()[index])))
        place += len(tokens) + len(grammar.templates[index + 1])
    return max(differences)


def main(options: Options) -> int:
    missing = [name for name in ("torch", "transformers") if find_spec(name) is None]
    if missing:
        print(f"{' and '.join(missing)} missing: pip install torch transformers peft", file=sys.stderr)
        return UNAVAILABLE
    import torch  # pyright: ignore[reportMissingImports]

    tokenizer = load_tokenizer(options.tokenizer) if options.tokenizer else small_tokenizer("sentencepiece")
    grammar = build_answer_grammar(tokenizer, 1, "paper")
    vision = VisionConfig(image_size=16, patch_size=16, width=32, layers=1, heads=2)
    config = ModelConfig(vision=vision, language=LANGUAGE)
    theirs = their_model()
    variables = our_variables(theirs, config)
    prompt = format_prompt("close the jar", STATE, KEYPOINT, "paper")
    text, _ = encode_text(tokenizer, prompt, None, 512)
    length = int(text.mask.sum())
    inputs = ModelInputs(
        images=jnp.ones((1, 1, 16, 16, 3)),
        point_tokens=jnp.zeros((1, 0, 32)),
        point_patches=jnp.zeros((1, 0), jnp.int32),
        text=jax.tree.map(lambda leaf: jnp.asarray(leaf[None, :length]), text),
    )
    decode = make_decoder(VLA(config), grammar)
    visual: Any = VLA(config).apply(variables, inputs, method=lambda model, x: model.projector(model.encode_vision(x)))
    embedded = theirs.get_input_embeddings()(torch.from_numpy(text.tokens[None, :length]).long()).detach().numpy()
    embeddings = np.concatenate([np.asarray(visual), embedded], axis=1)
    variables = unstack_layers(variables)
    decoded = decode(variables, inputs)
    answer = len(grammar.tokens(np.asarray(decoded.integers[0])))
    parameters = sum(parameter.numel() for parameter in theirs.parameters())
    print(f"{parameters / 1e6:.0f} M parameters, {length} prompt tokens, {answer} answer tokens, {cores()} cores")

    def generate() -> None:
        with torch.no_grad():
            theirs.generate(
                inputs_embeds=torch.from_numpy(embeddings),
                attention_mask=torch.ones(embeddings.shape[:2], dtype=torch.long),
                do_sample=False,
                use_cache=True,
                min_new_tokens=answer,
                max_new_tokens=answer,
                pad_token_id=0,
            )

    generate()
    seconds: dict[str, list[tuple[float, float]]] = {"ours": [], "theirs": []}
    for _ in range(options.repeats):
        for name, run in (("ours", lambda: jax.block_until_ready(decode(variables, inputs))), ("theirs", generate)):
            start = time.perf_counter(), time.process_time()
            run()
            seconds[name].append((time.perf_counter() - start[0], time.process_time() - start[1]))
    for name, times in seconds.items():
        wall, processor = (sorted(column) for column in zip(*times, strict=True))
        print(
            f"{name}: {statistics.median(wall):.3f} s an action (from {wall[0]:.3f} to {wall[-1]:.3f}), "
            f"{statistics.median(processor):.3f} s of processor time"
        )
    pairs = zip(seconds["ours"], seconds["theirs"], strict=True)
    ratio = statistics.median(theirs[0] / ours[0] for ours, theirs in pairs)
    difference = largest_difference(theirs, embeddings, grammar, decoded)
    free = sum(
        len(slot.tokens[value - slot.low]) for value, slot in zip(decoded.integers.ravel(), grammar.slots, strict=True)
    )
    print(f"ratio {ratio:.2f} (at least {options.limit}); {decoded.passes} passes for {free} signs and digits")
    print(f"largest difference of a log-probability: {difference:.1e} (at most 1e-3)")
    return int(ratio < options.limit or difference > 1e-3 or decoded.passes > free + 1)


if __name__ == "__main__":
    with fail_with_message():
        sys.exit(main(tyro.cli(Options, description=__doc__)))
