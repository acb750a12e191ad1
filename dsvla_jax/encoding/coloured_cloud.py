"""Pictures to small coloured point clouds, for policies that read points themselves."""

import jax
import jax.numpy as jnp
from jaxtyping import Float

from dsvla_jax.encoding.config import EncodingConfig
from dsvla_jax.encoding.farthest_point import farthest_point_sample
from dsvla_jax.encoding.point_cloud import cloud_from_depth
from dsvla_jax.types import Array, Picture


def coloured_cloud(
    pictures: Picture[Array], config: EncodingConfig
) -> tuple[Float[Array, "b p 3"], Float[Array, "b p 3"]]:
    """Samples `points.num_points` points of the workspace of a batch, far from each other, that any camera sees.

    Returns their places (metres, world frame) and colours (0 to 1).
    """
    batch, cameras, height, width = pictures.depth.shape
    config.require_points(height, width, cameras)
    cloud = jax.vmap(
        lambda depth, camera: cloud_from_depth(
            depth, camera, config.workspace_low, config.workspace_high, config.stride
        )
    )
    each = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), (pictures.depth, pictures.camera))
    points, valid = (x.reshape(batch, -1, *x.shape[2:]) for x in cloud(*each))
    colours = pictures.rgb[:, :, :: config.stride, :: config.stride].reshape(*points.shape) / 255
    chosen = farthest_point_sample(points, valid, config.points.num_points)[..., None]
    return jnp.take_along_axis(points, chosen, axis=1), jnp.take_along_axis(colours, chosen, axis=1)
