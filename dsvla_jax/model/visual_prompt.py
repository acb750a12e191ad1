"""Visual tokens as prompts of the language model's layers: LLaMA-Adapter's projection module.

Zhang et al. 2023, "LLaMA-Adapter", and Gao et al. 2023, "LLaMA-Adapter V2", in the form that ManipLLM (Li et al. 2024)
gave it. Parameters have the names of those works. What a layer does with its prompt is in ``llama.DecoderBlock``.
"""

import dataclasses
from functools import partial

import flax.linen as nn
import jax.numpy as jnp
import numpy as np

from dsvla_jax.model.config import LanguageConfig, ModelConfig
from dsvla_jax.model.layers import layer_norm, over_layers
from dsvla_jax.model.llama import DecoderBlock, LayerPrompts, PromptTokens, RMSNorm, rotary_tables
from dsvla_jax.model.lora import LoraDense
from dsvla_jax.model.partition import constrain
from dsvla_jax.types import Array


def visual_blocks_config(config: ModelConfig) -> ModelConfig:
    """The visual blocks as a decoder's configuration: they are its layers, without mask and adapters."""
    prompt = config.visual_prompt
    blocks = LanguageConfig(
        width=prompt.width,
        layers=prompt.layers,
        heads=prompt.heads,
        kv_heads=prompt.heads,
        ffn=prompt.ffn,
        rope_theta=prompt.rope_theta,
        norm_eps=prompt.norm_eps,
    )
    return dataclasses.replace(
        config, language=blocks, visual_prompt=dataclasses.replace(prompt, prompted_layers=None), lora=None
    )


class VisualPrompt(nn.Module):
    """Vision outputs (B, 1 + C N + G, vision output width) and point_patches int32 (B, G) -> the prompts of all layers.

    The prompt of a layer is the projected tokens plus rows that the layer learns, one for each query, or for CLS and
    each image patch. A 3D token has the place and the rows of the patch that it is aligned with: its order among the
    others means nothing, and no parameter depends on the number of 3D tokens. The patches of all cameras share places
    and rows, as they share positional embeddings. Layers that look at no prompt get zeros
    behind a gate of zero, so that all layers stay one loop.
    """

    config: ModelConfig

    @nn.compact
    def __call__(self, vision_outputs: Array, point_patches: Array) -> tuple[PromptTokens, LayerPrompts]:
        """What all layers share, and what each has of its own."""
        prompt, language, dtype = self.config.visual_prompt, self.config.language, self.config.compute_dtype
        batch = vision_outputs.shape[0]
        linear = partial(LoraDense, use_bias=True, dtype=dtype)

        x = linear(prompt.width, name="clip_proj")(vision_outputs)
        x = layer_norm(1e-5, "clip_proj_norm")(x).astype(dtype)
        patches = self.config.vision.num_patches
        row_count = 1 + patches
        of_images = np.concatenate([[0], *[np.arange(1, row_count)] * self.config.cameras])
        rows = jnp.broadcast_to(of_images, (batch, len(of_images)))
        rows = jnp.concatenate([rows, 1 + point_patches % patches], axis=1)
        positions, length = rows, row_count
        if prompt.queries:
            row_count = prompt.queries
            queries = self.param("visual_query", nn.initializers.normal(1.0), (row_count, prompt.width))
            queries = jnp.broadcast_to(queries.astype(dtype), (batch, *queries.shape))
            x = jnp.concatenate([queries, x], axis=1)
            rows = jnp.broadcast_to(jnp.arange(row_count), (batch, row_count))
            positions, length = jnp.concatenate([rows, row_count + positions], axis=1), row_count + length

        blocks = visual_blocks_config(self.config)
        in_axes = (nn.broadcast, nn.broadcast)
        layers = over_layers(DecoderBlock, blocks, prompt.layers, in_axes)(blocks, name="visual_blocks")
        x, _ = layers(x, rotary_tables(positions, blocks.language, length), None)
        x = RMSNorm(prompt.norm_eps, name="visual_blocks_norm")(x[:, : rows.shape[1]])
        x = LoraDense(prompt.width, name="visual_blocks_output", dtype=dtype)(x)
        x = linear(language.width, name="visual_proj")(x)
        tokens = constrain(layer_norm(1e-5, "visual_proj_norm")(x).astype(dtype), "batch")

        # Small rows: every layer's prompt starts as the visual tokens. A gate of zero: the language model starts as is.
        count = self.config.prompted_layers
        layer_rows = self.param("adapter_query", nn.initializers.normal(0.02), (count, row_count, language.width))
        gate = self.param("gate", nn.initializers.zeros_init(), (count, language.heads))
        unprompted = (language.layers - count, 0)
        layer_rows = jnp.pad(layer_rows, (unprompted, (0, 0), (0, 0)))
        gate = jnp.pad(gate, (unprompted, (0, 0)))
        return PromptTokens(tokens, rows), LayerPrompts(layer_rows, gate)
