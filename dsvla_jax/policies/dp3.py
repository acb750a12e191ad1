"""3D Diffusion Policy (Ze et al. 2024, "3D Diffusion Policy", https://arxiv.org/abs/2403.03954), for keyframes.

Kept: the small point encoder (a layer for each point, then the maximum over points), the one-dimensional U-Net with
scale and shift from the condition, a network that predicts the clean answer, few denoising steps. Changed: its horizon
is the next keyframes and not the next tenths of a second; positions and rotations are as in `pose_vectors`; and since
one policy learns all tasks here, the points' feature looks at the words of the instruction, which the original does not
have.
"""

import dataclasses
from functools import cached_property
from typing import cast

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from dsvla_jax.encoding.coloured_cloud import coloured_cloud
from dsvla_jax.encoding.config import EncodingConfig
from dsvla_jax.encoding.pose_inputs import ARMS
from dsvla_jax.model.variables import Variables
from dsvla_jax.policies.config import DP3_GROUPS, DP3_HEADS, DP3Config
from dsvla_jax.policies.diffusion import add_noise, denoise, signal_shares
from dsvla_jax.policies.pose_network import Vectors, mean_over_arm
from dsvla_jax.policies.pose_vectors import VECTOR, VectorSpace, center, scale_position
from dsvla_jax.policies.robot_vector import robot_vector, robot_width, with_waves
from dsvla_jax.types import Array, PoseInputs, Text

KERNEL = 5
# Width of the noise level's embedding, and the longest of its wavelengths in levels.
LEVEL_WIDTH, LONGEST = 128, 10000.0


class PointEncoder(nn.Module):
    """Points (B, P, 3 or 6) -> (B, width): a few layers for each point, then the maximum over points."""

    channels: tuple[int, ...]
    width: int

    @nn.compact
    def __call__(self, points: Array) -> Array:
        """points: places scaled to the box, with colours or without."""
        x = points
        for number, width in enumerate(self.channels):
            x = nn.relu(nn.LayerNorm(name=f"norm_{number}")(nn.Dense(width, name=f"layer_{number}")(x)))
        return nn.LayerNorm(name="norm")(nn.Dense(self.width, name="out")(x.max(axis=1)))


class Condition(nn.Module):
    """What the denoising network is told: points, words and the robot -> (B, 3 * feature)."""

    config: DP3Config
    vocabulary: int

    @nn.compact
    def __call__(self, points: Array, words: Text[Array], robot: Array) -> Array:
        """points (B, P, 3 or 6), and robot (B, R) as `robot_vector` gives it."""
        width = self.config.feature
        seen = PointEncoder(self.config.point_channels, width, name="points")(points)
        embedded = nn.Embed(self.vocabulary, width, name="words")(words.tokens)
        mask = words.mask[:, None, None]
        for number in range(self.config.language_layers):
            attention = nn.MultiHeadDotProductAttention(DP3_HEADS, name=f"language_{number}")
            seen += attention(nn.LayerNorm(name=f"query_norm_{number}")(seen)[:, None], embedded, mask=mask)[:, 0]
        count = words.mask.sum(axis=1, keepdims=True)
        mean = jnp.where(words.mask[..., None], embedded, 0).sum(axis=1) / count
        state = nn.Dense(width, name="robot_out")(nn.relu(nn.Dense(width, name="robot_in")(with_waves(robot))))
        return jnp.concatenate([seen, mean, state], axis=-1)


class Convolution(nn.Module):
    """A convolution over keyframes (B, U, C) -> (B, ceil(U / stride), features), zeros beyond the ends.

    One product over all taps that reach a keyframe: there are few keyframes, and XLA's convolutions over so few places
    take several times as long on a CPU.
    """

    features: int
    kernel: int
    stride: int = 1

    @nn.compact
    def __call__(self, x: Array) -> Array:
        """x: float32."""
        length, channels = x.shape[1:]
        weights = self.param("kernel", nn.initializers.lecun_normal(), (self.kernel, channels, self.features))
        bias = self.param("bias", nn.initializers.zeros_init(), (self.features,))
        half = self.kernel // 2
        taps = range(max(0, half - length + 1), min(self.kernel, half + length))
        padded = jnp.pad(x, ((0, 0), (half, half), (0, 0)))
        windows = [padded[:, tap : tap + length : self.stride] for tap in taps]
        product = weights[taps.start : taps.stop].reshape(-1, self.features)
        return jnp.concatenate(windows, axis=-1) @ product + bias


class ResidualBlock(nn.Module):
    """Two convolutions over the keyframes (B, U, channels), the first one's result scaled and shifted."""

    channels: int

    @nn.compact
    def __call__(self, x: Array, condition: Array) -> Array:
        """condition (B, D) -> (B, U, `channels`)."""

        def convolve(x: Array, name: str) -> Array:
            x = Convolution(self.channels, KERNEL, name=name)(x)
            return jax.nn.mish(nn.GroupNorm(DP3_GROUPS, name=f"{name}_norm")(x))

        scale, shift = jnp.split(nn.Dense(2 * self.channels, name="film")(jax.nn.mish(condition)), 2, axis=-1)
        y = convolve(x, "first") * (1 + scale[:, None]) + shift[:, None]
        y = convolve(y, "second")
        return y + (x if x.shape[-1] == self.channels else nn.Dense(self.channels, name="skip")(x))


class UNet(nn.Module):
    """Noisy vectors (B, U, D), noise levels and a condition -> clean vectors (B, U, D)."""

    channels: tuple[int, ...]

    @nn.compact
    def __call__(self, noisy: Array, level: Array, condition: Array) -> Array:
        """level: int32 (B,). condition: (B, D)."""
        half = LEVEL_WIDTH // 2
        angles = level[:, None] * jnp.asarray(LONGEST ** (-np.arange(half) / (half - 1)))
        waves = jnp.concatenate([jnp.sin(angles), jnp.cos(angles)], axis=-1)
        step = nn.Dense(LEVEL_WIDTH, name="level_out")(jax.nn.mish(nn.Dense(4 * LEVEL_WIDTH, name="level_in")(waves)))
        condition = jnp.concatenate([step, condition], axis=-1)
        x, skips = noisy, []
        for number, width in enumerate(self.channels):
            x = ResidualBlock(width, name=f"down_{number}_0")(x, condition)
            x = ResidualBlock(width, name=f"down_{number}_1")(x, condition)
            skips.append(x)
            if number < len(self.channels) - 1:
                x = Convolution(width, 3, 2, name=f"shorten_{number}")(x)
        for number in range(2):
            x = ResidualBlock(self.channels[-1], name=f"middle_{number}")(x, condition)
        for number in range(len(self.channels) - 1, 0, -1):
            x = jnp.concatenate([x, skips[number]], axis=-1)
            width = self.channels[number - 1]
            x = ResidualBlock(width, name=f"up_{number}_0")(x, condition)
            x = ResidualBlock(width, name=f"up_{number}_1")(x, condition)
            length = skips[number - 1].shape[1]
            x = Convolution(width, 3, name=f"lengthen_{number}")(jnp.repeat(x, 2, axis=1)[:, :length])
        x = jnp.concatenate([x, skips[0]], axis=-1)
        x = ResidualBlock(self.channels[0], name="up_0")(x, condition)
        return nn.Dense(noisy.shape[-1], name="out")(x)


class Denoiser(nn.Module):
    """Condition and U-Net as one network."""

    config: DP3Config
    vocabulary: int

    def setup(self) -> None:
        """Makes both parts."""
        self.condition = Condition(self.config, self.vocabulary)
        self.unet = UNet(self.config.channels)

    def __call__(self, noisy: Array, level: Array, points: Array, words: Text[Array], robot: Array) -> Array:
        """Clean vectors (B, U, D) from noisy ones; see the parts."""
        return self.unet(noisy, level, self.condition(points, words, robot))


@dataclasses.dataclass(frozen=True)
class DP3:
    """See `PoseNetwork`."""

    config: DP3Config
    encoding: EncodingConfig
    space: VectorSpace
    vocabulary: int
    """Tokens that an instruction may have."""

    @property
    def upcoming(self) -> int:
        """See `PoseNetwork`."""
        return self.config.upcoming

    @cached_property
    def _shares(self) -> np.ndarray:
        return signal_shares(self.config.diffusion_steps)

    @property
    def _network(self) -> Denoiser:
        return Denoiser(self.config, self.vocabulary)

    def initialise(self, key: Array) -> Variables:
        """See `PoseNetwork`."""
        words = Text(jnp.zeros((1, 2), jnp.int32), jnp.ones((1, 2), bool))
        points = jnp.zeros((1, self.encoding.points.num_points, 6 if self.config.colours else 3))
        noisy, robot = jnp.zeros((1, self.upcoming, ARMS * VECTOR)), jnp.zeros((1, robot_width(self.config.look_back)))
        init = jax.jit(lambda key: self._network.init(key, noisy, jnp.zeros(1, jnp.int32), points, words, robot))
        return dict(init(key))

    def _condition(self, variables: Variables, inputs: PoseInputs[Array]) -> Array:
        codec = self.encoding.codec
        points, colours = coloured_cloud(inputs.pictures, self.encoding)
        points = scale_position(points, center(codec), codec)
        if self.config.colours:
            points = jnp.concatenate([points, colours], axis=-1)
        robot = robot_vector(inputs, codec, self.config.look_back)
        run = lambda network: network.condition(points, inputs.words, robot)  # noqa: E731
        return cast(Array, self._network.apply(variables, method=run))

    def _clean(self, variables: Variables, noisy: Array, level: Array, condition: Array, arms: Array) -> Array:
        # A missing arm has no noise to read an answer from.
        noisy = jnp.where(jnp.repeat(arms, VECTOR, axis=1)[:, None], noisy, 0)
        run = lambda network: network.unet(noisy, level, condition)  # noqa: E731
        return cast(Array, self._network.apply(variables, method=run))

    def losses(
        self, variables: Variables, inputs: PoseInputs[Array], target: Vectors, key: Array
    ) -> tuple[Float[Array, "b 2"], Vectors | None]:
        """See `PoseNetwork`: squared errors of the clean vectors at a random noise level of each example."""
        level_key, noise_key = jax.random.split(key)
        level = jax.random.randint(level_key, (len(target),), 0, self.config.diffusion_steps)
        flat = target.reshape(*target.shape[:2], -1)
        noisy = add_noise(flat, jax.random.normal(noise_key, flat.shape), level, self._shares)
        condition = self._condition(variables, inputs)
        clean = self._clean(variables, noisy, level, condition, inputs.arms).reshape(target.shape)
        return mean_over_arm(jnp.square(clean - target)), None

    def answer(self, variables: Variables, inputs: PoseInputs[Array], key: Array) -> Vectors:
        """See `PoseNetwork`. The noise is the same for every example."""
        condition = self._condition(variables, inputs)
        shape = (len(condition), self.upcoming, ARMS * VECTOR)
        noise = jnp.broadcast_to(jax.random.normal(key, shape[1:]), shape)
        clean = denoise(
            lambda noisy, level: self._clean(variables, noisy, level, condition, inputs.arms),
            noise,
            self._shares,
            self.config.inference_steps,
            np.tile(self.space.largest, ARMS),
        )
        return clean.reshape(*shape[:2], ARMS, VECTOR)
