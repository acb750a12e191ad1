"""Multi-head attention over head-major arrays, shared by both towers."""

import jax
import jax.numpy as jnp

from dsvla_jax.types import Array

# A finite "minus infinity": a row that is masked everywhere (padding) then gives a mean instead of NaN.
MASKED = -1e30


def split_heads(x: Array, heads: int) -> Array:
    """(B, T, heads * D) -> (B, heads, T, D)."""
    batch, length, width = x.shape
    return x.reshape(batch, length, heads, width // heads).swapaxes(1, 2)


def join_heads(x: Array) -> Array:
    """(B, heads, T, D) -> (B, T, heads * D)."""
    batch, heads, length, depth = x.shape
    return x.swapaxes(1, 2).reshape(batch, length, heads * depth)


def has_cudnn() -> bool:
    """Whether attention can be one cuDNN kernel here."""
    return jax.default_backend() == "gpu"


def attend(query: Array, key: Array, value: Array, mask: Array | None = None, implementation: str = "auto") -> Array:
    """Softmax attention, the softmax in float32.

    query: (B, H, T, D). key, value: (B, Hkv, S, D), H a multiple of Hkv (grouped queries: query head h uses key head
    h // (H / Hkv)). mask: bool, broadcastable to (B, T, S), True where a query may look; None for everywhere.
    implementation: see ``ModelConfig.attention``.
    Returns (B, H, T, D) in the query's dtype.
    """
    batch, heads, length, depth = query.shape
    kv_heads = key.shape[1]
    if implementation == "auto":
        implementation = "explicit" if jax.default_backend() == "cpu" else "fused"
    if implementation == "cudnn" and not has_cudnn():
        # What was trained on a GPU acts elsewhere too.
        implementation = "fused"
    if implementation != "explicit":
        output = jax.nn.dot_product_attention(
            query.swapaxes(1, 2),
            key.swapaxes(1, 2),
            value.swapaxes(1, 2),
            mask=None if mask is None else mask[:, None],
            implementation="cudnn" if implementation == "cudnn" else "xla",
        )
        return output.swapaxes(1, 2)
    # The query heads that share a key head are laid out as more queries of it: two plain batched products. The mask is
    # added, and the sum of the weights divided out behind the second product, because both make the gradient quicker.
    groups = heads // kv_heads
    grouped = (query * depth**-0.5).reshape(batch, kv_heads, groups * length, depth)
    scores = jnp.einsum("bhtd,bhsd->bhts", grouped, key, preferred_element_type=jnp.float32)
    if mask is not None:
        scores = scores + jnp.tile(jnp.where(mask, 0.0, MASKED), (1, groups, 1))[:, None]
    weights = jnp.exp(scores - jax.lax.stop_gradient(scores.max(axis=-1, keepdims=True)))
    total = weights.sum(axis=-1, keepdims=True)
    output = jnp.einsum("bhts,bhsd->bhtd", weights.astype(value.dtype), value, preferred_element_type=jnp.float32)
    return (output / total).astype(query.dtype).reshape(batch, heads, length, depth)
