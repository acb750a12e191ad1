"""The parts of configs that compile in seconds."""

from typing import Any

from dsvla_jax.encoding.config import EncodingConfig
from dsvla_jax.encoding.point_tokens import PointTokenizerConfig
from dsvla_jax.model.config import LanguageConfig, VisionConfig

# Options of train.py: the smallest model that has every part.
SMALL_RUN = """
    tiny --run run --log-every 1 --batch-size 2 --encoding.image-size 32 --encoding.patch-size 16
    --encoding.points.num-points 64 --encoding.points.group-sizes 16 4 --encoding.points.neighbours 4
    --encoding.points.width 32 --model.vision.image-size 32 --model.vision.patch-size 16 --model.vision.width 32
    --model.vision.layers 1 --model.vision.heads 2 --model.language.width 32 --model.language.layers 1
    --model.language.heads 2 --model.language.kv-heads 2 --model.language.ffn 64 --model.scan-unroll 1
"""


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
