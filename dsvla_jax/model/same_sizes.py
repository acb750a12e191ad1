"""The sizes that an encoding and a model must share: each stands in both configs."""

from dsvla_jax.encoding.config import EncodingConfig
from dsvla_jax.errors import UserError
from dsvla_jax.model.config import ModelConfig

# (option of the encoding, option of the model): what goes wrong where they differ.
SHARED = {
    ("image_size", "model.vision.image_size"): "the vision tower could not read the picture",
    ("patch_size", "model.vision.patch_size"): "3D tokens would carry the positional embeddings of other patches",
    ("points.width", "model.vision.width"): "3D tokens could not enter the vision tower",
}


def require_same_sizes(encoding: EncodingConfig, model: ModelConfig) -> None:
    """Raises UserError if the model was made for other pictures, patches or 3D tokens than the encoding gives.

    Also if alignment index_order has fewer patches than 3D tokens.
    """
    vision = model.vision
    encoded = (encoding.image_size, encoding.patch_size, encoding.points.width)
    expected = (vision.image_size, vision.patch_size, vision.width)
    for ((ours, theirs), trouble), one, other in zip(SHARED.items(), encoded, expected, strict=True):
        if one != other:
            raise UserError(
                f"encoding.{ours} is {one} and {theirs} is {other}: {trouble}; set both to the same number "
                f"({_option(f'encoding.{ours}')} {other}, or {_option(theirs)} {one})"
            )
    encoding.require_patches(model.cameras)


def _option(name: str) -> str:
    return "--" + name.replace("_", "-")
