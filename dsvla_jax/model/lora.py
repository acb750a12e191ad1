"""A linear layer that may carry a low-rank adapter, and the algebra of adapters.

The base weights live in the collection "params", the adapters in "lora", at the same path:
params/.../kernel (in, out) beside lora/.../a (in, rank) and lora/.../b (rank, out); a leading layers axis where the
layer is scanned over. Freezing, saving adapters alone and merging are therefore tree operations.
Hu et al. 2021, "LoRA: Low-Rank Adaptation of Large Language Models", equation 3.
"""

from collections.abc import Mapping

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax import traverse_util
from jax.typing import DTypeLike

from dsvla_jax.model.config import LoraConfig
from dsvla_jax.model.layers import KERNEL_INIT, Initializer
from dsvla_jax.model.quantize import SCALE, dequantize
from dsvla_jax.model.variables import flat_variables
from dsvla_jax.types import Array


def _adapter_init(kind: str) -> Initializer:
    if kind == "normal":
        return nn.initializers.normal(0.02)
    return nn.initializers.variance_scaling(1.0 / 3.0, "fan_in", "uniform")


@jax.custom_vjp
def adapted_product(x: Array, kernel: Array, a: Array, b: Array) -> Array:
    """x (N, in) times W + A B, which is formed: kernel (in, out), a (in, rank), b (rank, out).

    For many rows that is quicker than x W + (x A) B, whose thin products a CPU is slow at. The gradients are those of
    the sum, without the one of W where nobody asks for it. W + A B in 16 bits would round the adapter away.
    """
    return x @ (kernel + a @ b)


def _adapted_forward(x: Array, kernel: Array, a: Array, b: Array) -> tuple[Array, tuple[Array, ...]]:
    return adapted_product(x, kernel, a, b), (x, kernel, a, b)


def _adapted_backward(saved: tuple[Array, ...], gradient: Array) -> tuple[Array, ...]:
    x, kernel, a, b = saved
    return gradient @ (kernel + a @ b).T, x.T @ gradient, x.T @ (gradient @ b.T), (x @ a).T @ gradient


adapted_product.defvjp(_adapted_forward, _adapted_backward)


class LoraDense(nn.Module):
    """y = x W + b + (alpha / rank) x A B over the last axis of x.

    The adapter is used when the variables hold one; merged weights have none, and run through the same module. So is
    the scale of a kernel in 8 bits.
    ``adapted=False`` leaves it out for one call.
    """

    features: int
    use_bias: bool = False
    lora: LoraConfig | None = None
    dtype: DTypeLike = jnp.float32
    kernel_init: Initializer = KERNEL_INIT

    @nn.compact
    def __call__(self, x: Array, adapted: bool = True) -> Array:
        """x (..., in) -> (..., features), of `dtype`."""
        inputs = x.shape[-1]
        # Tokens are merged into one axis: of a 3D product XLA's CPU compiler would transpose the output's gradient, and
        # compute all that is fused into it again, for the kernel's gradient.
        leading = x.shape[:-1]
        x = x.reshape(-1, inputs).astype(self.dtype)
        kernel = self.param("kernel", self.kernel_init, (inputs, self.features), jnp.float32)
        quantized = self.has_variable("params", SCALE)
        lora = self.lora
        present = self.is_initializing() or self.has_variable("lora", "a")
        a = b = None
        if adapted and lora is not None and self.name in lora.targets and present:
            a_init = _adapter_init(lora.init)
            a = self.variable("lora", "a", lambda: a_init(self.make_rng("params"), (inputs, lora.rank), jnp.float32))
            b = self.variable("lora", "b", lambda: jnp.zeros((lora.rank, self.features), jnp.float32))
            a, b = a.value.astype(self.dtype), b.value.astype(self.dtype) * lora.scale
        formed = self.dtype == jnp.float32 and not quantized and len(x) > inputs
        if a is not None and formed:
            y = adapted_product(x, kernel.astype(self.dtype), a, b)
        else:
            y = x @ kernel.astype(self.dtype)
            if quantized:
                y = y * self.get_variable("params", SCALE).astype(self.dtype)
            if a is not None and b is not None:
                y = y + (x @ a) @ b
        if self.use_bias:
            bias = self.param("bias", nn.initializers.zeros_init(), (self.features,), jnp.float32)
            y = y + bias.astype(self.dtype)
        return y.reshape(*leading, self.features)


def _add_adapters(params: Mapping, adapters: Mapping, scale: float) -> dict:
    flat, flat_adapters = flat_variables(dequantize(params)), flat_variables(adapters)
    for path in flat_adapters:
        if path[-1] != "a":
            continue
        kernel_path = (*path[:-1], "kernel")
        if kernel_path not in flat:
            raise ValueError(
                f"adapter {'/'.join(map(str, path[:-1]))} has no kernel in the base weights: adapters and base weights "
                "come from different models"
            )
        a, b = flat_adapters[path], flat_adapters[(*path[:-1], "b")]
        kernel = flat[kernel_path]
        delta = scale * jnp.matmul(a.astype(jnp.float32), b.astype(jnp.float32), precision="highest")
        if delta.shape != kernel.shape:
            raise ValueError(
                f"adapter {'/'.join(map(str, path[:-1]))}: A B has shape {delta.shape}, the kernel {kernel.shape}"
            )
        flat[kernel_path] = (kernel.astype(jnp.float32) + delta).astype(kernel.dtype)
    return traverse_util.unflatten_dict(flat)


def require_mergeable(variables: Mapping) -> None:
    """Raises ValueError where no base weights alone give the outputs of ``variables`` with its adapters.

    A visual prompt's keys and values are made with the language model's base weights, so with fusion "adapter" its
    adapters of k and v cannot be part of those.
    """
    in_language = variables.get("lora", {}).get("language", {}).get("layers", {})
    if "gate" in variables["params"].get("projector", {}) and {"k", "v"} & set(in_language):
        raise ValueError(
            "adapters of k and v in the language model cannot be merged with fusion 'adapter': the visual prompt's "
            "keys and values are made without them; keep the adapters apart, or train with LoraConfig(targets=...) "
            "without k and v"
        )


def merge_lora(variables: Mapping, lora: LoraConfig) -> dict:
    """Add the adapters to the base weights: {"params", "lora"} -> {"params"} of the same outputs without adapters.

    A part of a model will do. Raises ValueError as `require_mergeable` does.
    """
    require_mergeable(variables)
    return {"params": _add_adapters(variables["params"], variables.get("lora", {}), lora.scale)}


def unmerge_lora(merged: Mapping, adapters: Mapping, lora: LoraConfig) -> dict:
    """Inverse of ``merge_lora`` given the tree of adapters: {"params"} -> {"params", "lora"}. Exact up to rounding."""
    return {"params": _add_adapters(merged["params"], adapters, -lora.scale), "lora": adapters}
