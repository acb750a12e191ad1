"""Pictures of many episodes at a time: what the cameras of an environment see of its states."""

import dataclasses
from typing import NamedTuple

import jax
import mujoco
from flax import struct

from dsvla_jax.geometry.cameras import front_camera
from dsvla_jax.sim import raycast
from dsvla_jax.sim.physics import SimState
from dsvla_jax.types import Array, Camera

MAX_RAYS = 2**21  # cast at once over all episodes: more need gigabytes


class Rendering(NamedTuple):
    """Pictures of B episodes.

    rgb: uint8 (B, H, W, 3). depth: float32 (B, H, W), planar, metres; 0 where nothing is hit. segmentation: int32
    (B, H, W), geom ids, -1 for the sky.
    """

    rgb: Array
    depth: Array
    segmentation: Array


@struct.dataclass
class Renderer:
    """How the states of one model are drawn.

    primitives: the model's visible geoms. camera: the front camera (of one example). image_size: height and width,
    pixels. shadows: whether the sun casts them. varied: whether each episode has geom sizes, a camera and light of its
    own, in its state; otherwise those of the renderer count.
    """

    primitives: raycast.Primitives
    camera: Camera
    image_size: int = struct.field(pytree_node=False)
    shadows: bool = struct.field(pytree_node=False)
    varied: bool = struct.field(pytree_node=False)


def make_renderer(model: mujoco.MjModel, image_size: int, shadows: bool = True, varied: bool = False) -> Renderer:
    """Makes the renderer of a model, seen by the front camera. Raises ValueError for geoms that cannot be drawn."""
    return Renderer(raycast.primitives_from_model(model), front_camera(image_size), image_size, shadows, varied)


def render(renderer: Renderer, state: SimState) -> Rendering:
    """Draws what the front camera sees of B episodes."""
    if renderer.varied:
        return render_from(renderer, state, state.camera)
    return _render(renderer, state, renderer.camera, own_camera=False)


def render_from(renderer: Renderer, state: SimState, camera: Camera) -> Rendering:
    """Draws what one camera of each of B episodes sees: intrinsics (B, 3, 3), world_from_camera (B, 4, 4)."""
    return _render(renderer, state, camera, own_camera=True)


def _render(renderer: Renderer, state: SimState, camera: Camera, own_camera: bool) -> Rendering:
    """camera: one for all episodes, unless each has its own."""
    primitives = renderer.primitives
    sizes, light = primitives.sizes, primitives.light_direction
    if renderer.varied:
        sizes, light = state.geom_size, state.light
    block = min(raycast.MAX_BLOCK_RAYS, MAX_RAYS // len(state.geom_xpos))

    def draw(
        geom_xpos: Array, geom_xmat: Array, geom_rgba: Array, geom_size: Array, camera: Camera, light: Array
    ) -> Rendering:
        return Rendering(
            *raycast.render(
                dataclasses.replace(primitives, sizes=geom_size, light_direction=light),
                geom_xpos,
                geom_xmat,
                geom_rgba,
                camera,
                renderer.image_size,
                renderer.image_size,
                shadows=renderer.shadows,
                max_block_rays=block,
            )
        )

    own = 0 if renderer.varied else None
    axes = (0, 0, 0, own, 0 if own_camera else None, own)
    return jax.vmap(draw, in_axes=axes)(state.geom_xpos, state.geom_xmat, state.geom_rgba, sizes, camera, light)
