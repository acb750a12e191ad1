"""Pictures to small coloured point clouds, for policies that read points themselves."""

import jax.numpy as jnp
from jaxtyping import Float

from dsvla_jax.encoding.config import EncodingConfig
from dsvla_jax.encoding.farthest_point import farthest_point_sample
from dsvla_jax.encoding.point_cloud import joint_cloud
from dsvla_jax.types import Array, Picture


def coloured_cloud(
    pictures: Picture[Array], config: EncodingConfig
) -> tuple[Float[Array, "b p 3"], Float[Array, "b p 3"]]:
    """Samples `points.num_points` points of the workspace of a batch, far from each other, that any camera sees.

    Returns their places (metres, world frame) and colours (0 to 1).
    """
    points, valid = joint_cloud(pictures, config)
    colours = pictures.rgb[:, :, :: config.stride, :: config.stride].reshape(*points.shape) / 255
    chosen = farthest_point_sample(points, valid, config.points.num_points)[..., None]
    return jnp.take_along_axis(points, chosen, axis=1), jnp.take_along_axis(colours, chosen, axis=1)
