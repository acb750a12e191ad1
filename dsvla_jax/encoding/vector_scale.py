"""An affine normalisation that is fitted to data: every number of a vector has the range -1 to 1."""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from dsvla_jax.encoding.displacement import is_constant
from dsvla_jax.types import Array


@dataclasses.dataclass(frozen=True)
class VectorScale:
    """The range of each number: `low` to `high`, in the number's own unit.

    A number that does not vary (by more than `displacement.LEAST_RANGE`) is moved to 0 and not stretched.
    """

    low: tuple[float, ...]
    high: tuple[float, ...]

    def __post_init__(self) -> None:
        if len(self.low) != len(self.high) or any(a > b for a, b in zip(self.low, self.high, strict=True)):
            raise ValueError(f"VectorScale: expected as many low <= high, got {self.low} and {self.high}")

    def _middle_and_half(self) -> tuple[np.ndarray, np.ndarray]:
        low, high = np.array(self.low, np.float32), np.array(self.high, np.float32)
        return (low + high) / 2, np.where(is_constant(low, high), 1, (high - low) / 2)

    def to_unit(self, vectors: Float[Array, "*b n"]) -> Float[Array, "*b n"]:
        """Vectors -> vectors whose numbers are -1 at `low` and 1 at `high`."""
        middle, half = self._middle_and_half()
        return (vectors - middle) / half

    def from_unit(self, vectors: Float[Array, "*b n"]) -> Float[Array, "*b n"]:
        """The inverse of `to_unit`."""
        middle, half = self._middle_and_half()
        return jnp.asarray(vectors) * half + middle


def fit_vector_scale(vectors: Float[np.ndarray, "k n"]) -> VectorScale:
    """The scale whose ranges are those of the vectors' numbers."""
    return VectorScale(tuple(vectors.min(axis=0).tolist()), tuple(vectors.max(axis=0).tolist()))
