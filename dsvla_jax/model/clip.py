"""CLIP's vision transformer over 2D patches and 3D tokens in one sequence.

Radford et al. 2021 (the architecture of openai/CLIP's ViT). The sequence is [CLS | 2D patches | 3D tokens], the patches
camera by camera; a 3D token carries the positional embedding of the patch that its centre projects onto (2D-to-3D
positional alignment), so the pretrained encoder needs no new parameters for it. All cameras share one table of
positions; one learned embedding for each of several cameras tells them apart.
"""

from functools import partial

import flax.linen as nn
import jax
import jax.numpy as jnp

from dsvla_jax.model.attention import attend, join_heads, split_heads
from dsvla_jax.model.config import ModelConfig
from dsvla_jax.model.layers import KERNEL_INIT, layer_norm, over_layers, residual_init
from dsvla_jax.model.lora import LoraDense
from dsvla_jax.model.partition import constrain
from dsvla_jax.model.variables import CAMERA_EMBEDDING
from dsvla_jax.types import Array


def quick_gelu(x: Array) -> Array:
    """x sigmoid(1.702 x), CLIP's approximation of GELU."""
    return x * jax.nn.sigmoid(1.702 * x)


def patchify(image: Array, patch_size: int) -> Array:
    """(B, S, S, 3) -> (B, N, patch_size * patch_size * 3): row-major patches, row-major pixels within one."""
    batch, size, _, channels = image.shape
    grid = size // patch_size
    patches = image.reshape(batch, grid, patch_size, grid, patch_size, channels).swapaxes(2, 3)
    return patches.reshape(batch, grid * grid, patch_size * patch_size * channels)


class VisionBlock(nn.Module):
    """One pre-norm transformer layer: full attention, then a QuickGELU MLP."""

    config: ModelConfig

    @nn.compact
    def __call__(self, x: Array, _: None = None) -> tuple[Array, None]:
        """x (B, T, width) -> the same shape, and None for the loop over layers."""
        vision, dtype = self.config.vision, self.config.compute_dtype
        linear = partial(LoraDense, use_bias=True, lora=self.config.lora_for("vision"), dtype=dtype)
        into_residual = residual_init(vision.layers)

        x = constrain(x, "batch")
        y = layer_norm(vision.norm_eps, "attention_norm")(x)
        query, key, value = (split_heads(linear(vision.width, name=n)(y), vision.heads) for n in "qkv")
        y = join_heads(attend(query, key, value, implementation=self.config.attention))
        x = x + linear(vision.width, kernel_init=into_residual, name="o")(y)

        y = layer_norm(vision.norm_eps, "mlp_norm")(x)
        y = quick_gelu(linear(vision.ffn, name="up")(y))
        x = x + linear(vision.width, kernel_init=into_residual, name="down")(y)
        return x, None


class VisionTower(nn.Module):
    """Images, 3D tokens and their patches -> (B, 1 + C N + G, output width).

    images: float32 (B, C, S, S, 3). point_tokens: (B, G, D), G may be 0. point_patches: int32 (B, G), camera * N +
    patch. The outputs are those of ``ln_post`` for every token, in the order [CLS | 2D | 3D]; with an ``embed_width``,
    times CLIP's projection into the joint embedding.
    """

    config: ModelConfig

    @nn.compact
    def __call__(self, images: Array, point_tokens: Array, point_patches: Array) -> Array:
        """The outputs of every token. Raises ValueError for inputs of other sizes than the config's."""
        vision, dtype = self.config.vision, self.config.compute_dtype
        cameras = self.config.cameras
        expected = (cameras, vision.image_size, vision.image_size, 3)
        if images.shape[1:] != expected:
            raise ValueError(
                f"images: expected (B, {', '.join(map(str, expected))}), got {images.shape}; resize them in the "
                "encoding, and give one of each camera that the model was made for"
            )
        if point_tokens.shape[-1] != vision.width:
            raise ValueError(
                f"point_tokens: expected width {vision.width} (the vision tower's), got {point_tokens.shape[-1]}; set "
                "the 3D tokenizer's width"
            )
        # A convolution whose stride is its kernel size is a product with flattened patches, and quicker as one.
        kernel = self.param(
            "patch_kernel",
            nn.initializers.lecun_normal(in_axis=(0, 1, 2)),
            (vision.patch_size,) * 2 + (3, vision.width),
        )
        embedding_init = nn.initializers.normal(vision.width**-0.5)
        class_embedding = self.param("class_embedding", embedding_init, (vision.width,))
        positions = self.param("positional_embedding", embedding_init, (1 + vision.num_patches, vision.width))

        batch = images.shape[0]
        pixels = patchify(images.reshape(-1, *images.shape[2:]), vision.patch_size).astype(dtype)
        patches = pixels.reshape(-1, pixels.shape[-1]) @ kernel.reshape(-1, vision.width).astype(dtype)
        patches = patches.reshape(batch, cameras * vision.num_patches, vision.width)
        tokens_2d = jnp.concatenate(
            [jnp.broadcast_to(class_embedding, (batch, 1, vision.width)), patches.astype(jnp.float32)], axis=1
        )
        # Where each token of the sequence is: CLS, the patches of every camera, and the patches of the 3D tokens.
        if cameras > 1:
            per_camera = self.param(CAMERA_EMBEDDING, nn.initializers.zeros_init(), (cameras, vision.width))
            places = positions[1:] + per_camera[:, None]
            positions = jnp.concatenate([positions[:1], places.reshape(-1, vision.width)])
        tokens_3d = point_tokens.astype(jnp.float32) + positions[1 + point_patches]
        x = jnp.concatenate([tokens_2d + positions, tokens_3d], axis=1)

        x = layer_norm(vision.norm_eps, "ln_pre")(x).astype(dtype)
        x, _ = over_layers(VisionBlock, self.config, vision.layers)(self.config, name="layers")(x, None)
        x = layer_norm(vision.norm_eps, "ln_post")(x)
        if vision.embed_width is None:
            return x
        projection = self.param("projection", KERNEL_INIT, (vision.width, vision.embed_width))
        return x.astype(dtype) @ projection.astype(dtype)
