"""Pictures to small coloured point clouds, for policies that read points themselves."""

import jax
import jax.numpy as jnp
from jaxtyping import Float

from dsvla_jax.encoding.config import EncodingConfig
from dsvla_jax.encoding.farthest_point import farthest_point_sample
from dsvla_jax.encoding.point_cloud import cloud_from_depth
from dsvla_jax.types import Array, Picture


def coloured_cloud(
    picture: Picture[Array], config: EncodingConfig
) -> tuple[Float[Array, "b p 3"], Float[Array, "b p 3"]]:
    """Samples `points.num_points` points of the workspace from each picture of a batch, far from each other.

    Returns their places (metres, world frame) and colours (0 to 1).
    """
    height, width = picture.depth.shape[1:]
    config.require_points(height, width)
    points, valid = jax.vmap(
        lambda depth, camera: cloud_from_depth(
            depth, camera, config.workspace_low, config.workspace_high, config.stride
        )
    )(picture.depth, picture.camera)
    colours = picture.rgb[:, :: config.stride, :: config.stride].reshape(*points.shape) / 255
    chosen = farthest_point_sample(points, valid, config.points.num_points)[..., None]
    return jnp.take_along_axis(points, chosen, axis=1), jnp.take_along_axis(colours, chosen, axis=1)
