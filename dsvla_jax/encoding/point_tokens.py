"""The 3D tokenizer: a point cloud to tokens without a single learned weight.

After Point-NN (Zhang et al., 2023) as 3DS-VLA uses it: trigonometric features of the coordinates, then stages that
each group neighbours around fewer centres, append the centre's features, add a positional encoding of the neighbours'
relative coordinates, and pool by maximum. Each stage doubles the channels.
"""

import dataclasses
import itertools

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from dsvla_jax.encoding.neighbours import k_nearest_neighbours
from dsvla_jax.errors import UserError
from dsvla_jax.ranges import Range, at_least, check_fields, more_than
from dsvla_jax.types import Array


@dataclasses.dataclass(frozen=True)
class PointTokenizerConfig:
    """Sizes and scales of the 3D tokenizer (paper, section 3.2)."""

    num_points: int = 2048
    """Points that are sampled from the cloud."""
    group_sizes: tuple[int, ...] = (1344, 880, 576)
    """Centres of each stage; the last is the number of 3D tokens."""
    neighbours: int = 16
    """Points that are grouped around each centre."""
    width: int = 1024
    """Channels of a 3D token; the first features have width / 2^stages."""
    alpha: float = 1000.0
    """Ratio of the highest to the lowest frequency of the positional encoding."""
    beta: float = 100.0
    """Highest frequency of the positional encoding, radians a unit of the scaled coordinates."""
    center: tuple[float, float, float] = (0.2, 0.0, 1.1)
    """Centre of the workspace cube, metres, world frame; the cube is scaled to [-1, 1]."""
    half_extent: float = 0.5
    """Half the side of the workspace cube, metres."""
    token_rms: float = 1.0
    """Root mean square of every token after standardisation. Set it to that of the vision tower's patch embeddings:
    larger tokens would drown the positional embeddings added to them."""

    def __post_init__(self) -> None:
        check_fields(
            self,
            "encoding.points",
            num_points=at_least(1),
            group_sizes=at_least(1),
            neighbours=at_least(1),
            width=at_least(1),
            alpha=more_than(0, at_most=1e6),
            # Sines are exact for angles of up to 1e4 (`_sine`).
            beta=more_than(0, at_most=1e4),
            center=Range(-1000, 1000),
            half_extent=at_least(1e-3, at_most=1000),
            token_rms=more_than(0, at_most=1000),
        )
        levels = (self.num_points, *self.group_sizes)
        if len(levels) < 2 or any(after > before for before, after in itertools.pairwise(levels)):
            raise UserError(
                f"encoding.points.group_sizes: expected one or more, falling, at most num_points {self.num_points}; "
                f"got {self.group_sizes}"
            )
        if self.width % 2 ** len(self.group_sizes) or self.base_width < 6:
            raise UserError(
                f"encoding.points.width: expected a multiple of 2^stages ({2 ** len(self.group_sizes)}) that leaves 6 "
                f"channels or more for the first features, got {self.width}"
            )
        if self.neighbours > levels[-2]:
            raise UserError(
                f"encoding.points.neighbours: expected at most {levels[-2]}, the last stage's points, got "
                f"{self.neighbours}"
            )

    @property
    def base_width(self) -> int:
        """Channels before the first stage."""
        return self.width // 2 ** len(self.group_sizes)

    @property
    def num_tokens(self) -> int:
        """G."""
        return self.group_sizes[-1]


def positional_encoding(coordinates: ArrayLike, channels: int, alpha: float, beta: float) -> Array:
    """Sines and cosines of coordinates (..., 3) at geometrically spaced frequencies -> (..., channels).

    Axis by axis, and within an axis sin_0, cos_0, sin_1, cos_1, ... of beta p / alpha^(k / F), F = channels // 6, as
    in Point-NN; the channels that 6 does not divide are zero, at the end.
    """
    frequencies = channels // 6
    scale = np.repeat(beta / alpha ** (np.arange(frequencies) / max(frequencies, 1)), 2)
    by_axis = np.zeros((3, channels), np.float32)
    for axis in range(3):
        by_axis[axis, axis * 2 * frequencies : (axis + 1) * 2 * frequencies] = scale
    cosine = np.arange(channels) % 2 == 1
    cosine[6 * frequencies :] = False
    x, y, z = jnp.split(jnp.asarray(coordinates, jnp.float32), 3, axis=-1)
    # Each channel has one term that is not zero; as a sum over axes it stays one vectorised loop.
    return _sine(x * by_axis[0] + y * by_axis[1] + z * by_axis[2], quarter_turn=cosine)


def _sine(angles: Array, quarter_turn: np.ndarray) -> Array:
    """sin(angles), or cos(angles) where ``quarter_turn``; within 4e-7 for angles up to 1e4 radians.

    XLA's own sine is a call for each element on a CPU, which made it three quarters of the tokenizer's time there.
    This one is plain arithmetic that vectorises: the angle is reduced to r in [-pi/2, pi/2] by a whole number n of half
    turns, with pi split into a part that n multiplies exactly and a remainder, then the Taylor series up to r^11.
    """
    half = np.where(quarter_turn, 0.5, 0.0).astype(np.float32)
    turns = jnp.round(angles * np.float32(1 / np.pi) - half)
    whole = turns + half
    high = np.float32(3.140625)
    r = angles - whole * high - whole * np.float32(np.pi - 3.140625)
    square = r * r
    series = np.float32(-1 / 39916800)
    for denominator in (362880, -5040, 120, -6):
        series = np.float32(1 / denominator) + square * series
    sine = r + r * square * series
    odd = turns - 2 * jnp.floor(0.5 * turns)
    # sin(r + n pi) = (-1)^n sin r, and cos(r + (n + 1/2) pi) = -(-1)^n sin r.
    return sine * (1 - 2 * odd) * np.where(quarter_turn, -1.0, 1.0).astype(np.float32)


def tokenize_points(points: ArrayLike, config: PointTokenizerConfig) -> tuple[Array, Array]:
    """One cloud to its 3D tokens.

    Args:
        points: float (P, 3), metres, world frame, **in farthest-point order**, so that the centres of each stage are
            the first points of the stage before.

    Returns:
        tokens: float32 (G, width). centers: float32 (G, 3), the first G of the given points, metres, world frame.
    """
    points = jnp.asarray(points, jnp.float32)
    if points.shape != (config.num_points, 3):
        raise ValueError(f"points: expected shape ({config.num_points}, 3), got {points.shape}; use vmap for a batch")
    scaled = (points - jnp.array(config.center, jnp.float32)) / config.half_extent
    features = positional_encoding(scaled, config.base_width, config.alpha, config.beta)
    for count in config.group_sizes:
        features = _group(scaled, features, count, config)
        scaled = scaled[:count]
    mean = jnp.mean(features, axis=-1, keepdims=True)
    deviation = jnp.std(features, axis=-1, keepdims=True)
    tokens = (features - mean) / (deviation + 1e-5) * config.token_rms
    return tokens, points[: config.num_tokens]


def _group(scaled: Array, features: Array, count: int, config: PointTokenizerConfig) -> Array:
    """One stage: (P, 3) and (P, C) -> (count, 2C)."""
    centers, center_features = scaled[:count], features[:count]
    neighbours = k_nearest_neighbours(centers, scaled, config.neighbours)
    relative = scaled[neighbours] - centers[:, None, :]
    # Point-NN divides by the deviation over the whole batch. Over one cloud, batch-mates cannot change its tokens.
    relative = relative / (jnp.std(relative, ddof=1) + 1e-5)
    channels = features.shape[-1]

    # Neighbour by neighbour with a running maximum, unrolled: the (count, K, 2C) tensor, by far the largest of the
    # input path, never exists, and on a CPU the loop fuses and vectorises, several times faster than max over an axis.
    # The centre's features are the same for all neighbours and are added after pooling.
    def encode(neighbour: int) -> Array:
        return positional_encoding(relative[:, neighbour], 2 * channels, config.alpha, config.beta)

    near, own = jnp.split(encode(0), 2, axis=-1)
    near = near + features[neighbours[:, 0]]
    for neighbour in range(1, config.neighbours):
        next_near, next_own = jnp.split(encode(neighbour), 2, axis=-1)
        near = jnp.maximum(near, next_near + features[neighbours[:, neighbour]])
        own = jnp.maximum(own, next_own)
    return jnp.concatenate([near, center_features + own], axis=-1)
