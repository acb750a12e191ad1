"""A LLaMA decoder: RMSNorm, rotary positions (half-rotation layout), grouped-query attention, SwiGLU.

Touvron et al. 2023; parameter layout and rotation as in Hugging Face's Llama.
"""

import dataclasses

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from dsvla_jax.model.attention import attend, join_heads, split_heads
from dsvla_jax.model.config import LanguageConfig, ModelConfig
from dsvla_jax.model.layers import KERNEL_INIT, Initializer, over_layers, rematerialised, residual_init
from dsvla_jax.model.lora import LoraDense
from dsvla_jax.model.partition import constrain
from dsvla_jax.types import Array


@struct.dataclass
class PromptTokens:
    """The part of the visual prompts that all layers share.

    tokens: (B, P, width). rows: int32 (B, P), which of a layer's own rows is added to each.
    """

    tokens: Array
    rows: Array


@struct.dataclass
class LayerPrompts:
    """The part of the visual prompts that each layer has of its own: rows (layers, R, width), gate (layers, heads)."""

    rows: Array
    gate: Array


@struct.dataclass
class PromptCache:
    """Every layer's keys and values of its prompt, (layers, B, kv_heads, P, D), and gate (layers, heads)."""

    keys: Array
    values: Array
    gate: Array


@struct.dataclass
class KVCache:
    """Keys (rotated) and values of every layer: (layers, B, kv_heads, S, D), S slots in order of writing.

    prompt: those of the visual prompts, which never change once they are there.
    """

    keys: Array
    values: Array
    prompt: PromptCache | None = None

    @classmethod
    def empty(cls, config: ModelConfig, batch: int, slots: int) -> "KVCache":
        """A cache of zeros, without a prompt."""
        language = config.language
        shape = (language.layers, batch, language.kv_heads, slots, language.head_dim)
        zeros = jnp.zeros(shape, config.compute_dtype)
        return cls(zeros, zeros)


class RMSNorm(nn.Module):
    """x / rms(x) * scale over the last axis, in float32."""

    epsilon: float

    @nn.compact
    def __call__(self, x: Array) -> Array:
        """x (..., width) -> float32 of the same shape."""
        scale = self.param("scale", nn.initializers.ones_init(), (x.shape[-1],))
        x = x.astype(jnp.float32)
        return x * jax.lax.rsqrt(jnp.mean(jnp.square(x), axis=-1, keepdims=True) + self.epsilon) * scale


def rotary_frequencies(config: LanguageConfig) -> np.ndarray:
    """Radians a position, float32 (D / 2,). Computed in double: an error would grow with the position."""
    half = config.head_dim // 2
    frequencies = config.rope_theta ** (-np.arange(half) / half)
    scaling = config.rope_scaling
    if scaling is not None:
        # How often the wavelength fits into the original context decides between stretching and leaving alone.
        fits = scaling.original_context * frequencies / (2 * np.pi)
        low, high = scaling.low_frequency_factor, scaling.high_frequency_factor
        kept = np.clip((fits - low) / (high - low), 0.0, 1.0)
        frequencies = frequencies * (kept + (1 - kept) / scaling.factor)
    return frequencies.astype(np.float32)


def rotary_tables(positions: Array, config: LanguageConfig, length: int) -> tuple[Array, Array]:
    """Positions int32 (B, T), all below ``length``, -> cosines and sines, float32 (B, T, 1, D / 2)."""
    # Read from constants: XLA would work every cosine out again for each layer, head and example, where it is used.
    angles = np.arange(length, dtype=np.float32)[:, None] * rotary_frequencies(config)
    cosine, sine = (jnp.asarray(table)[positions][:, :, None] for table in (np.cos(angles), np.sin(angles)))
    return cosine, sine


def rotate(x: Array, tables: tuple[Array, Array]) -> Array:
    """Rotate the pairs (x[i], x[i + D/2]) of each head of (B, T, heads * D) by their position's angle, in float32."""
    cosine, sine = tables
    heads = x.reshape(*x.shape[:2], -1, 2 * cosine.shape[-1]).astype(jnp.float32)
    first, second = jnp.split(heads, 2, axis=-1)
    rotated = jnp.concatenate([first * cosine - second * sine, second * cosine + first * sine], axis=-1)
    return rotated.astype(x.dtype).reshape(x.shape)


class DecoderBlock(nn.Module):
    """One layer. With a cache, keys and values are written at slot ``index`` and the queries look at all its slots.

    With a visual prompt the queries look at that too, in an attention with a softmax of its own, whose output is added
    behind the gate tanh(g) of each head (Zhang et al. 2023, "LLaMA-Adapter"). A prompt's keys and values are products
    with the base weights alone: no adapter, no norm, no rotation.

    Only the positions from ``first_row`` on are queries, and have an output.
    """

    config: ModelConfig
    first_row: int = 0

    @nn.compact
    def __call__(
        self,
        x: Array,
        tables: tuple[Array, Array],
        mask: Array | None,
        cache: KVCache | None = None,
        index: Array | int = 0,
        shared: PromptTokens | None = None,
        prompt: LayerPrompts | PromptCache | None = None,
    ) -> tuple[Array, KVCache | None]:
        """x (B, T, width) and `rotary_tables` -> the layer's outputs, and its cache with keys and values written.

        mask: bool (B or 1, T, S), the slots each position may look at; all if None. See `Llama.__call__` for the rest.
        """
        language, dtype = self.config.language, self.config.compute_dtype
        into_residual = residual_init(language.layers)
        x = constrain(x, "batch")

        def linear(name: str, width: int, kernel_init: Initializer = KERNEL_INIT) -> LoraDense:
            bias, lora = name in language.biases, self.config.lora_for("language")
            return LoraDense(width, name=name, use_bias=bias, lora=lora, dtype=dtype, kernel_init=kernel_init)

        query_width, kv_width = language.heads * language.head_dim, language.kv_heads * language.head_dim

        y = RMSNorm(language.norm_eps, name="attention_norm")(x)
        # Rotated before the heads are split: rotating what is transposed is slow on a CPU, and so is its gradient.
        x, query, query_tables = jax.tree.map(lambda rows: rows[:, self.first_row :], (x, y, tables))
        query = split_heads(rotate(linear("q", query_width)(query), query_tables), language.heads)
        to_key, to_value = (linear(name, kv_width) for name in "kv")
        key = split_heads(rotate(to_key(y), tables), language.kv_heads)
        value = split_heads(to_value(y), language.kv_heads)
        if cache is not None:
            key = jax.lax.dynamic_update_slice_in_dim(cache.keys, key, index, axis=2)
            value = jax.lax.dynamic_update_slice_in_dim(cache.values, value, index, axis=2)
            cache = KVCache(key, value)
        mask = None if mask is None else mask[:, self.first_row :]
        attended = attend(query, key, value, mask, self.config.attention)
        if shared is not None and isinstance(prompt, LayerPrompts):
            tokens = shared.tokens + constrain(constrain(prompt.rows.astype(dtype))[shared.rows], "batch")
            prompt_key, prompt_value = (
                split_heads(project(tokens, adapted=False), language.kv_heads) for project in (to_key, to_value)
            )
            prompt = PromptCache(prompt_key, prompt_value, prompt.gate)
            cache = None if cache is None else dataclasses.replace(cache, prompt=prompt)
        if isinstance(prompt, PromptCache):
            gate = jnp.tanh(prompt.gate)[:, None, None].astype(dtype)
            attended += gate * attend(query, prompt.keys, prompt.values, implementation=self.config.attention)
        y = join_heads(attended)
        x = x + linear("o", language.width, kernel_init=into_residual)(y)

        y = RMSNorm(language.norm_eps, name="mlp_norm")(x)
        gate = linear("gate", language.ffn)(y)
        up = linear("up", language.ffn)(y)
        y = jax.nn.silu(gate) * up
        x = x + linear("down", language.width, kernel_init=into_residual)(y)
        return x, cache


class Llama(nn.Module):
    """Embeddings in, normalised hidden states out; ``embed`` and ``lm_head`` are the two ends."""

    config: ModelConfig

    def setup(self) -> None:
        """Makes embeddings, layers and the last norm."""
        language = self.config.language
        # Unit-norm rows: with tied weights the first logits then have unit variance.
        self.embedding = self.param(
            "embedding", nn.initializers.normal(language.width**-0.5), (language.vocab_size, language.width)
        )
        self.layers = over_layers(
            DecoderBlock,
            self.config,
            language.layers,
            in_axes=(nn.broadcast, nn.broadcast, 0, nn.broadcast, nn.broadcast, 0),
        )(self.config)
        self.norm = RMSNorm(language.norm_eps)
        if not language.tie_embeddings:
            self.output = self.param(
                "output", nn.initializers.normal(language.width**-0.5), (language.width, language.vocab_size)
            )

    def embed(self, tokens: Array) -> Array:
        """int32 (B, T) -> (B, T, width)."""
        # The table is gathered, not what is read from it: of a table split by width, XLA would gather all examples.
        table = constrain(self.embedding.astype(self.config.compute_dtype), "vocab")
        return constrain(table[tokens], "batch")

    def __call__(
        self,
        x: Array,
        positions: Array,
        mask: Array,
        cache: KVCache | None = None,
        index: Array | int = 0,
        prompts: tuple[PromptTokens, LayerPrompts] | None = None,
        first_row: int = 0,
    ) -> tuple[Array, KVCache | None]:
        """x (B, T, width), positions int32 (B or 1, T) below S, mask bool (B or 1, T, S) -> hidden states, new cache.

        The hidden states are those from ``first_row`` on, (B, T - first_row, width).

        Without a cache S is T. With one, its S slots are attended to, after slots index..index+T-1 are overwritten.
        prompts: the visual prompts, which also go into the cache; later calls find them there and need none.
        """
        tables = rotary_tables(positions, self.config.language, mask.shape[-1])
        shared, layer_prompts = prompts or (None, None)
        unrolled = self.config.scan_unroll >= self.config.language.layers
        if first_row and unrolled and cache is None and prompts is None and not self.is_initializing():
            x, first_row = self._unrolled(x, tables, mask, first_row), 0
        elif cache is None or cache.prompt is None:
            x, cache = self.layers(x, tables, mask, cache, index, shared, layer_prompts)
        else:
            # The prompt goes beside the cache and not in it, so that the loop over layers does not write it anew.
            cached = cache.prompt
            x, text = self.layers(x, tables, mask, dataclasses.replace(cache, prompt=None), index, None, cached)
            assert text is not None
            cache = KVCache(text.keys, text.values, cached)
        return self.norm(x[:, first_row:]).astype(self.config.compute_dtype), cache

    def _unrolled(self, x: Array, tables: tuple[Array, Array], mask: Array, first_row: int) -> Array:
        """All layers, the last one for the rows from ``first_row`` on alone: nobody reads its other outputs.

        A loop over stacked layers cannot do that; unrolled, they need no such loop.
        """
        layers, block = self.config.language.layers, rematerialised(DecoderBlock, self.config)
        # Not indexed, because the gradient of `split` puts the layers' gradients side by side and adds up nothing.
        leaves, structure = jax.tree.flatten(self.layers.variables)
        parts = [jax.lax.split(leaf, (1,) * layers) for leaf in leaves]
        for layer in range(layers):
            variables = structure.unflatten([part[layer].squeeze(0) for part in parts])
            first = first_row if layer == layers - 1 else 0
            x, _ = block(self.config, first, parent=None).apply(variables, x, tables, mask)
        return x

    def lm_head(self, hidden: Array, tokens: np.ndarray | Array | None = None) -> Array:
        """(..., width) -> float32 logits (..., V), or those of ``tokens`` (U,) alone, (..., U)."""
        language, dtype = self.config.language, self.config.compute_dtype
        table, axis = (self.embedding, 1) if language.tie_embeddings else (self.output, 0)
        if tokens is not None:
            table = jnp.take(table, jnp.asarray(tokens), axis=1 - axis)
        flat = hidden.reshape(-1, language.width).astype(dtype)
        logits = jax.lax.dot_general(
            flat, table.astype(dtype), (((1,), (axis,)), ((), ())), preferred_element_type=jnp.float32
        )
        logits = logits.reshape(*hidden.shape[:-1], -1)
        # A few tokens' logits are whole everywhere.
        return logits if tokens is not None else constrain(logits, "batch", *(None,) * (logits.ndim - 2), "vocab")
