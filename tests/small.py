"""The parts of configs that compile in seconds."""

from typing import Any

from dsvla_jax.encoding.encode import EncodingConfig
from dsvla_jax.encoding.point_tokens import PointTokenizerConfig
from dsvla_jax.model.config import LanguageConfig, VisionConfig


def small_encoding(**changes: Any) -> EncodingConfig:
    """Pictures of 32 pixels in four patches, and four 3D tokens, for a vision tower of `small_vision`."""
    return EncodingConfig(
        image_size=32,
        patch_size=16,
        points=PointTokenizerConfig(num_points=32, group_sizes=(16, 4), neighbours=4, width=32),
        style="compact",
        **changes,
    )


def small_vision(layers: int = 1) -> VisionConfig:
    """A vision tower for `small_encoding`."""
    return VisionConfig(image_size=32, patch_size=16, width=32, layers=layers, heads=2)


def small_language(vocab_size: int, layers: int = 1) -> LanguageConfig:
    """A language model of 32 numbers a token."""
    return LanguageConfig(vocab_size=vocab_size, width=32, layers=layers, heads=2, kv_heads=2, ffn=64)
