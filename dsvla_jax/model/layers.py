"""What both towers are made of: initialisers, LayerNorm, and the loop over layers with its rematerialisation."""

from typing import TypeVar

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax.nn.initializers import Initializer

from dsvla_jax.model.config import ModelConfig

Layer = TypeVar("Layer", bound=nn.Module)

# Short names of jax.checkpoint_policies.
REMAT_POLICIES = {"full": "nothing_saveable", "dots": "dots_with_no_batch_dims_saveable"}

KERNEL_INIT = nn.initializers.lecun_normal()


def residual_init(layers: int) -> Initializer:
    """Kernels that write into a residual stream which 2 * layers of them add to, so that its variance stays bounded."""
    return nn.initializers.variance_scaling(1.0 / (2 * layers), "fan_in", "truncated_normal")


def layer_norm(epsilon: float, name: str) -> nn.LayerNorm:
    """LayerNorm computed in float32."""
    return nn.LayerNorm(epsilon=epsilon, dtype=jnp.float32, use_fast_variance=False, name=name)


def rematerialised(block: type[Layer], config: ModelConfig) -> type[Layer]:
    """``block`` as the config says that its backward pass is to be done."""
    if config.remat == "none":
        return block
    name = REMAT_POLICIES.get(config.remat, config.remat)
    return nn.remat(block, prevent_cse=False, policy=getattr(jax.checkpoint_policies, name))


def over_layers(block: type[Layer], config: ModelConfig, layers: int, in_axes: object = nn.broadcast) -> type[Layer]:
    """``block`` scanned over ``layers``: its variables get a leading layers axis; rematerialised as the config says."""
    return nn.scan(
        rematerialised(block, config),
        variable_axes={"params": 0, "lora": 0},
        split_rngs={"params": True},
        in_axes=in_axes,  # pyright: ignore[reportArgumentType], typed by its default, an int
        length=layers,
        unroll=config.scan_unroll,
    )
