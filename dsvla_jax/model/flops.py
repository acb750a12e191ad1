"""How many floating-point operations of matrix products one example needs, counted by hand from the architecture.

A product of (m, k) with (k, n) is 2 m k n. Training counts, for every product of the network, the forward pass; the
gradient of its input; the gradient of its weight only where the weight learns; and with rematerialisation the forward
pass again, without each block's last product, whose result nothing in the backward pass reads. Attention counts all
pairs, as the program computes them, and not only those that a causal mask leaves. An adapter is two thin
products, also where float32 training forms its sum with the matrix instead (`model.lora.adapted_product`). What comes
before the first weight that learns (patches) has a forward pass only.
"""

import dataclasses
from typing import Literal

from dsvla_jax.encoding.config import EncodingConfig
from dsvla_jax.model.config import LoraConfig, ModelConfig
from dsvla_jax.model.variables import Regime

# Passes over a product: of the blocks, computed again or not, and of what stands outside of them.
Passes = Literal["training", "inference"]


@dataclasses.dataclass(frozen=True)
class _Block:
    """One transformer layer, repeated.

    products: (name, tokens, inputs, outputs) in order. pairs: of its attentions, times heads and head width.
    """

    layers: int
    products: tuple[tuple[str, int, int, int], ...]
    pairs: int
    lora: LoraConfig | None
    learns: bool


def training_flops(encoding: EncodingConfig, model: ModelConfig, regime: Regime) -> dict[str, int]:
    """Of one example in one training step, by part of the network."""
    return _flops(encoding, model, regime, "training")


def model_flops(encoding: EncodingConfig, model: ModelConfig, regime: Regime) -> int:
    """Counts the FLOPs of one example in one training step, without what rematerialisation computes again.

    The utilisation of a chip is counted by them (PaLM, https://arxiv.org/abs/2204.02311, appendix B).
    """
    return sum(training_flops(encoding, dataclasses.replace(model, remat="none"), regime).values())


def prefill_flops(encoding: EncodingConfig, model: ModelConfig) -> dict[str, int]:
    """Of reading one example's pictures and prompt before an answer is decoded; the logits of one position."""
    return _flops(encoding, model, "full", "inference")


def _flops(encoding: EncodingConfig, config: ModelConfig, regime: Regime, passes: Passes) -> dict[str, int]:
    full, text = regime == "full", encoding.max_text_length
    vision, language, prompt = config.vision, config.language, config.visual_prompt
    patches = config.cameras * vision.num_patches
    tokens = 1 + patches + encoding.num_point_tokens
    training = passes == "training"

    clip = _Block(
        vision.layers,
        (
            *((name, tokens, vision.width, vision.width) for name in "qkvo"),
            ("up", tokens, vision.width, vision.ffn),
            ("down", tokens, vision.ffn, vision.width),
        ),
        tokens**2 * vision.width,
        config.lora_for("vision"),
        full,
    )
    total = {
        "patches": 2 * patches * 3 * vision.patch_size**2 * vision.width * (1 + (full and training)),
        "vision": _block_flops(clip, config, training),
    }
    # Outside of the blocks nothing is computed again.
    width = vision.width
    if vision.embed_width is not None:
        width = vision.embed_width
        total["vision projection"] = 2 * tokens * vision.width * width * (1 + training + (training and full))

    sequence, prompted = text, 0
    projects = regime != "adapters"
    learned = 2 + projects if training else 1
    if config.fusion == "prefix":
        sequence += tokens
        hidden = language.width if config.projector == "mlp" else 0
        products = width * hidden + hidden * language.width if hidden else width * language.width
        total["projector"] = 2 * tokens * products * learned
    else:
        queries = prompt.queries
        prompted, read = queries or tokens, tokens + queries
        blocks = _Block(
            prompt.layers,
            (
                *((name, read, prompt.width, prompt.width) for name in "qkvo"),
                *((name, read, prompt.width, prompt.ffn) for name in ("gate", "up")),
                ("down", read, prompt.ffn, prompt.width),
            ),
            read**2 * prompt.width,
            None,
            projects,
        )
        outside = tokens * width * prompt.width + prompted * prompt.width * (prompt.width + language.width)
        total["projector"] = _block_flops(blocks, config, training) + 2 * outside * learned

    attention_width, kv_width = language.heads * language.head_dim, language.kv_heads * language.head_dim
    llama = _Block(
        language.layers,
        (
            ("q", sequence, language.width, attention_width),
            ("k", sequence, language.width, kv_width),
            ("v", sequence, language.width, kv_width),
            # Of the visual prompt: with the base weights alone.
            ("prompt", prompted, language.width, 2 * kv_width),
            ("o", sequence, attention_width, language.width),
            ("gate", sequence, language.width, language.ffn),
            ("up", sequence, language.width, language.ffn),
            ("down", sequence, language.ffn, language.width),
        ),
        sequence * (sequence + prompted) * attention_width,
        config.lora_for("language"),
        full,
    )
    total["language"] = _block_flops(llama, config, training)
    positions = text if training else 1
    total["logits"] = 2 * positions * language.width * language.vocab_size * (1 + training + (training and full))
    return total


def _block_flops(block: _Block, config: ModelConfig, training: bool) -> int:
    again = 1 if training and config.remat == "full" else 0
    total = 0
    for name, tokens, inputs, outputs in block.products:
        last = name == "down"
        weights = 2 * tokens * inputs * outputs
        total += weights * ((1 + 1 + block.learns) + (again and not last) if training else 1)
        if block.lora is not None and name in block.lora.targets:
            a, b = (2 * tokens * side * block.lora.rank for side in (inputs, outputs))
            total += a * (3 + again) + b * (3 + (again and not last)) if training else a + b
    # Two products over the pairs; the gradient has two more for each.
    total += 2 * 2 * block.pairs * (3 + (again or (training and config.remat == "dots")) if training else 1)
    return total * block.layers
