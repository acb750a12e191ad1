"""The assembled policy network: vision tower -> projection -> LLaMA over the text -> logits.

Visual tokens enter LLaMA as a prefix to the text, or as prompts of its layers (``ModelConfig.fusion``).
"""

from functools import partial
from typing import cast

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from dsvla_jax.model.clip import VisionTower
from dsvla_jax.model.config import LanguageConfig, ModelConfig
from dsvla_jax.model.layers import layer_norm
from dsvla_jax.model.llama import KVCache, LayerPrompts, Llama, PromptTokens
from dsvla_jax.model.lora import LoraDense
from dsvla_jax.model.quantize import quantize
from dsvla_jax.model.variables import Variables
from dsvla_jax.model.visual_prompt import VisualPrompt
from dsvla_jax.types import Array, ModelInputs, Text

# Shortest and longest wavelength of the number embeddings, in integers. The shortest tells neighbours apart, the
# longest is twice the span of all numbers (-100..200), so that its phase never repeats.
NUMBER_WAVELENGTHS = (4.0, 600.0)


class Projector(nn.Module):
    """Vision outputs -> language width, LayerNorm last: the visual tokens of the prompt."""

    config: ModelConfig

    @nn.compact
    def __call__(self, x: Array) -> Array:
        """x (B, T, vision width) -> (B, T, language width)."""
        width, dtype = self.config.language.width, self.config.compute_dtype
        linear = partial(LoraDense, width, use_bias=True, dtype=dtype)
        if self.config.projector == "mlp":
            x = nn.gelu(linear(name="hidden")(x))
        x = linear(name="linear")(x)
        return layer_norm(1e-5, "norm")(x).astype(dtype)


class VLA(nn.Module):
    """``VLA(config).apply(variables, inputs)`` with batched ``ModelInputs`` -> float32 logits (B, T, V).

    The language model reads [visual tokens | text], all causal; with fusion "adapter" the text alone, and each layer
    its visual prompt. Logits are returned for the text positions: position t predicts text token t + 1. Text is padded
    at its end, so causality alone keeps padding out of every valid position.
    """

    config: ModelConfig

    def setup(self) -> None:
        """Makes the two towers and what is between them."""
        self.vision = VisionTower(self.config)
        # Both are the paper's projection module, and have one name, under which regimes and checkpoints know it.
        self.projector = VisualPrompt(self.config) if self.config.fusion == "adapter" else Projector(self.config)
        self.language = Llama(self.config)

    def encode_vision(self, inputs: ModelInputs) -> Array:
        """The vision tower's outputs (B, 1 + C N + G, vision output width), ordered [CLS | 2D | 3D]."""
        return self.vision(inputs.images, inputs.point_tokens, inputs.point_patches)

    def hidden(self, inputs: ModelInputs, text_from: int = 0) -> Array:
        """Hidden states (B, T - text_from, width) of the text positions from ``text_from`` on."""
        x, positions, prompts = self._sequence(inputs)
        mask = positions[:, :, None] >= positions[:, None, :]
        first_row = x.shape[1] - inputs.text.tokens.shape[1] + text_from
        return self.language(x, positions, mask, prompts=prompts, first_row=first_row)[0]

    def lm_head(self, hidden: Array, tokens: np.ndarray | Array | None = None) -> Array:
        """(..., width) -> float32 (..., V), or the logits of some ``tokens`` only.

        Apply it to chosen hidden states, or tokens, where the vocabulary is large.
        """
        return self.language.lm_head(hidden, tokens)

    def __call__(self, inputs: ModelInputs, text_from: int = 0) -> Array:
        """Logits float32 (B, T - text_from, V)."""
        return self.lm_head(self.hidden(inputs, text_from))

    def prefill(self, inputs: ModelInputs, more_slots: int) -> tuple[Array, KVCache]:
        """Read visual tokens or prompts, and text, into a fresh cache with ``more_slots`` unused slots at its end.

        Returns the hidden state (B, width) of each example's last valid text token, and the cache.
        """
        x, positions, prompts = self._sequence(inputs)
        batch, length, _ = x.shape
        cache = KVCache.empty(self.config, batch, length + more_slots)
        mask = positions[:, :, None] >= jnp.arange(length + more_slots)[None, None, :]
        x, cache = self._continue(x, positions, mask, cache, 0, prompts)
        text_lengths = inputs.text.mask.sum(axis=1)
        last = length - inputs.text.tokens.shape[1] + text_lengths - 1
        return jnp.take_along_axis(x, last[:, None, None], axis=1)[:, 0], cache

    def extend(
        self, tokens: Array, positions: Array, mask: Array, cache: KVCache, index: Array | int
    ) -> tuple[Array, KVCache]:
        """Read tokens int32 (B, C) at rotary ``positions`` (B, C) into the slots from ``index`` on.

        mask: bool (B, C, S), the slots each token may look at. Returns the hidden states (B, C, width).
        """
        return self._continue(self.language.embed(tokens), positions, mask, cache, index)

    def _continue(
        self,
        x: Array,
        positions: Array,
        mask: Array,
        cache: KVCache,
        index: Array | int,
        prompts: tuple[PromptTokens, LayerPrompts] | None = None,
    ) -> tuple[Array, KVCache]:
        x, written = self.language(x, positions, mask, cache, index, prompts)
        assert written is not None
        return x, written

    def _sequence(self, inputs: ModelInputs) -> tuple[Array, Array, tuple[PromptTokens, LayerPrompts] | None]:
        """What the language model reads: (B, T', width), its positions (1, T'), and the visual prompts if any."""
        visual, x, prompts = self.encode_vision(inputs), self.language.embed(inputs.text.tokens), None
        if isinstance(self.projector, VisualPrompt):
            prompts = self.projector(visual, inputs.point_patches)
        else:
            x = jnp.concatenate([self.projector(visual), x], axis=1)
        return x, jnp.arange(x.shape[1])[None], prompts


def prefill(model: VLA, variables: Variables, inputs: ModelInputs[Array], more_slots: int) -> tuple[Array, KVCache]:
    """Runs `VLA.prefill`."""
    return cast(tuple[Array, KVCache], model.apply(variables, inputs, more_slots, method=VLA.prefill))


def extend(
    model: VLA,
    variables: Variables,
    tokens: Array,
    positions: Array,
    mask: Array,
    cache: KVCache,
    index: Array | int,
) -> tuple[Array, KVCache]:
    """Runs `VLA.extend`."""
    extended = model.apply(variables, tokens, positions, mask, cache, index, method=VLA.extend)
    return cast(tuple[Array, KVCache], extended)


def lm_head(model: VLA, variables: Variables, hidden: Array, tokens: np.ndarray | Array | None = None) -> Array:
    """Runs `VLA.lm_head`."""
    return cast(Array, model.apply(variables, hidden, tokens, method=VLA.lm_head))


def number_embeddings(values: Array, width: int) -> Array:
    """Fourier features of numbers, (V,) -> (V, width), every row of mean square 1.

    Half sines, half cosines, at wavelengths that grow geometrically over ``NUMBER_WAVELENGTHS``: the inner product of
    two rows depends on their difference only and falls off smoothly with it.
    """
    half = width // 2
    wavelengths = jnp.geomspace(*NUMBER_WAVELENGTHS, half)
    angles = 2 * jnp.pi * values[:, None] / wavelengths
    features = jnp.concatenate([jnp.sin(angles), jnp.cos(angles)], axis=-1) * 2**0.5
    return jnp.pad(features, ((0, 0), (0, width - 2 * half)))


def blank_inputs(config: ModelConfig) -> ModelInputs[Array]:
    """Returns inputs of one example, for the shapes of variables."""
    vision = config.vision
    return ModelInputs(
        images=jnp.zeros((1, config.cameras, vision.image_size, vision.image_size, 3)),
        point_tokens=jnp.zeros((1, 1, vision.width)),
        point_patches=jnp.zeros((1, 1), jnp.int32),
        text=Text(jnp.zeros((1, 2), jnp.int32), jnp.ones((1, 2), bool)),
    )


def initialize(config: ModelConfig, key: Array, number_values: np.ndarray | Array | None = None) -> dict:
    """Random variables {"params", and "lora" where the config has adapters}. Pure: may be jitted with shardings.

    number_values: float32 (V,), the value of each token that is a number, NaN elsewhere. Given, those tokens' rows of
        the embedding (and of an untied output) start as Fourier features of their value, at the scale of the others,
        so that near numbers start near. Without it numbers are as random as words.
    """
    language = config.language
    variables = dict(jax.jit(VLA(config).init)(key, blank_inputs(config)))
    if number_values is not None:
        variables["params"] = embed_numbers(variables["params"], language, number_values)
    if config.base_dtype == "int8":
        variables["params"] = quantize(variables["params"])
    return variables


def embed_numbers(params: dict, language: LanguageConfig, number_values: np.ndarray | Array) -> dict:
    """Parameters whose number tokens are embedded by value, see ``initialize``."""
    values = jnp.asarray(number_values, jnp.float32)
    if values.shape != (language.vocab_size,):
        raise ValueError(
            f"number_values: expected ({language.vocab_size},), one for each token of the vocabulary, "
            f"got {values.shape}"
        )
    is_number = ~jnp.isnan(values)[:, None]
    features = number_embeddings(jnp.nan_to_num(values), language.width) * language.width**-0.5
    tables = dict(params["language"])
    tables["embedding"] = jnp.where(is_number, features, tables["embedding"])
    if not language.tie_embeddings:
        tables["output"] = jnp.where(is_number.T, features.T, tables["output"])
    return {**params, "language": tables}
