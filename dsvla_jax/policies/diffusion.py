"""Denoising diffusion of vectors whose network predicts the clean ones.

Ho et al. 2020, "Denoising Diffusion Probabilistic Models"; the squared cosine schedule of Nichol and Dhariwal 2021
(equation 17); sampling as Song et al. 2020, "Denoising Diffusion Implicit Models" (equation 12 without noise).
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from dsvla_jax.types import Array

# As in the paper: keeps the first noise levels from being too small, and the last from being infinite.
_OFFSET, _LARGEST_BETA = 0.008, 0.999


def signal_shares(steps: int) -> np.ndarray:
    """The variance of what is left of the clean vectors at each of so many noise levels, float32 (steps,)."""
    places = np.arange(steps + 1) / steps
    curve = np.cos((places + _OFFSET) / (1 + _OFFSET) * np.pi / 2) ** 2
    betas = np.minimum(1 - curve[1:] / curve[:-1], _LARGEST_BETA)
    return np.cumprod(1 - betas).astype(np.float32)


def add_noise(clean: Array, noise: Array, level: Int[Array, " b"], shares: np.ndarray) -> Array:
    """Clean vectors (B, ...) at each example's noise level."""
    share = jnp.asarray(shares)[level].reshape(-1, *(1,) * (clean.ndim - 1))
    return jnp.sqrt(share) * clean + jnp.sqrt(1 - share) * noise


def denoise(
    predict: Callable[[Array, Int[Array, " b"]], Array],
    noise: Array,
    shares: np.ndarray,
    steps: int,
    largest: float | np.ndarray = 1.0,
) -> Array:
    """Samples clean vectors from noise in so many steps.

    predict: (noisy vectors, noise level of each example) -> clean vectors.
    noise: float32 (B, ...).
    steps: at most as many as there are noise levels.
    largest: no number of a clean vector is further from 0; of all, or of each along the last axis.
    """
    levels = np.linspace(len(shares) - 1, 0, steps).round().astype(np.int32)
    before = np.concatenate([shares[levels], [1.0]]).astype(np.float32)

    def step(noisy: Array, one: tuple[Array, Array, Array]) -> tuple[Array, None]:
        level, share, next_share = one
        clean = jnp.clip(predict(noisy, jnp.full(len(noisy), level)), -largest, largest)
        left = (noisy - jnp.sqrt(share) * clean) / jnp.sqrt(1 - share)
        return jnp.sqrt(next_share) * clean + jnp.sqrt(1 - next_share) * left, None

    schedule = (jnp.asarray(levels), jnp.asarray(before[:-1]), jnp.asarray(before[1:]))
    return jax.lax.scan(step, noise, schedule)[0]
