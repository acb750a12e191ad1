"""Test conditions that training has not seen, along the four axes of the paper's Table 4.

    instance    objects of other colours and, where the task says that it stays feasible, of other sizes and proportions
    position    every object and piece of furniture moved by itself, so that their relative places change
    background  clutter on the table, another table top, light from elsewhere
    camera      another view of the table; its calibration is known, as that of the usual view is

Each is a pure function (scene, key, start of one episode) -> start; vmap them over episodes.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct

from dsvla_jax.errors import UserError
from dsvla_jax.geometry.rotations import quaternion_from_axis_angle, quaternion_to_matrix
from dsvla_jax.sim.scene import CLUTTER, Scene, SceneState
from dsvla_jax.types import TABLE_HEIGHT, Array, Camera

# Half ranges of what is drawn: the paper gives none.
HUE, BRIGHTNESS = np.pi, 0.2  # radians about the grey axis, relative
SIZE, PROPORTION = 0.1, 0.05  # relative: of a whole object, and of each side of a box besides
OFFSET = 0.03  # metres
ORBIT, TILT, DISTANCE = (
    np.deg2rad(20),
    np.deg2rad(8),
    0.08,
)  # of the camera about the middle of the table, the last relative
LIGHT = 0.5  # of the direction's horizontal part
MIDDLE = np.array([0.15, 0.0, TABLE_HEIGHT], np.float32)
# Clutter stands at the sides, where no task's object is: distances from the middle line, and along it.
ASIDE, ALONG = (0.34, 0.46), (0.02, 0.4)


@struct.dataclass
class Start:
    """How an episode begins, and how it is looked at.

    camera: of one example. light: float32 (3,), unit, the direction in which light travels. geom_size, geom_pos:
    float32 (ngeom, 3), in their bodies' frames.
    """

    scene: SceneState
    camera: Camera
    light: Array
    geom_size: Array
    geom_pos: Array


def check_shifts(names: Sequence[str]) -> tuple[str, ...]:
    """The names, in the order of ``SHIFTS``. Raises UserError for one that is none of them."""
    for name in names:
        if name not in SHIFTS:
            raise UserError(f"unknown shift {name!r}: expected some of {', '.join(SHIFTS)}")
    return tuple(name for name in SHIFTS if name in names)


def shift(scene: Scene, key: Array, start: Start) -> Start:
    """Applies the scene's shifts, each with a random stream of its own."""
    # Accelerators would otherwise multiply float32 matrices in fewer bits than a camera's pose bears.
    with jax.default_matmul_precision("highest"):
        for number, (name, apply) in enumerate(_FUNCTIONS.items()):
            if name in scene.shifts:
                start = apply(scene, jax.random.fold_in(key, number), start)
    return start


def other_instance(scene: Scene, key: Array, start: Start) -> Start:
    """Turns the hue of each of the task's bodies, and resizes those that the task lets.

    Where colours tell objects apart, it only brightens or darkens them.
    """
    model, task = scene.mj_model, scene.task
    hue_key, bright_key, size_key, side_key = jax.random.split(key, 4)
    mine = np.array([_is_of_task(model, geom) for geom in range(model.ngeom)])
    hue = jax.random.uniform(hue_key, (model.nbody,), minval=-HUE, maxval=HUE) * (0.0 if task.colours_matter else 1.0)
    bright = 1 + jax.random.uniform(bright_key, (model.nbody,), minval=-BRIGHTNESS, maxval=BRIGHTNESS)
    colour = jnp.clip(jax.vmap(_turn_hue)(start.scene.geom_rgba[:, :3], hue[model.geom_bodyid]), 0.0, 1.0)
    colour = jnp.clip(colour * bright[model.geom_bodyid][:, None], 0.0, 1.0)
    rgba = start.scene.geom_rgba.at[:, :3].set(jnp.where(mine[:, None], colour, start.scene.geom_rgba[:, :3]))

    size, position, qpos = start.geom_size, start.geom_pos, start.scene.qpos
    for number, name in enumerate(task.resizable):
        geoms = np.flatnonzero(model.geom_bodyid == model.body(name).id)
        whole = 1 + jax.random.uniform(jax.random.fold_in(size_key, number), (), minval=-SIZE, maxval=SIZE)
        sides = jax.random.uniform(jax.random.fold_in(side_key, number), (3,), minval=-PROPORTION, maxval=PROPORTION)
        boxes = np.all(model.geom_type[geoms] == mujoco.mjtGeom.mjGEOM_BOX) and np.all(model.geom_quat[geoms, 0] == 1)
        factor = whole * (1 + sides) if boxes else jnp.broadcast_to(whole, (3,))
        size = size.at[geoms].multiply(factor)
        position = position.at[geoms].multiply(factor)
        # It stays on what it stands on.
        height = scene.layout.free_address(name) + 2
        qpos = qpos.at[height].add((factor[2] - 1) * _reach_down(model, geoms))
    return replace(start, scene=replace(start.scene, geom_rgba=rgba, qpos=qpos), geom_size=size, geom_pos=position)


def other_position(scene: Scene, key: Array, start: Start) -> Start:
    """Moves each body, with all that rests on it, by up to ``OFFSET`` along x and y."""
    layout, task = scene.layout, scene.task
    carried = {attachment.body: attachment.carrier for attachment in task.attachments} | dict(task.rests_on)
    qpos, places = start.scene.qpos, start.scene.mocap_pos
    roots = [name for name in (*layout.mocap, *layout.free) if name not in carried and not name.startswith(CLUTTER)]
    offsets = jax.random.uniform(key, (len(roots), 2), minval=-OFFSET, maxval=OFFSET)
    for name in (*roots, *carried):
        root = name
        while root in carried:
            root = carried[root]
        offset = offsets[roots.index(root)]
        if name in layout.mocap:
            places = places.at[layout.mocap[name], :2].add(offset)
        else:
            address = layout.free_address(name)
            qpos = qpos.at[address : address + 2].add(offset)
    return replace(start, scene=replace(start.scene, qpos=qpos, mocap_pos=places))


def other_background(scene: Scene, key: Array, start: Start) -> Start:
    """Places the scene's clutter at the sides of the table, colours it and the table, and turns the light."""
    model = scene.mj_model
    table_key, clutter_key, colour_key, light_key = jax.random.split(key, 4)
    rgba, places = start.scene.geom_rgba, start.scene.mocap_pos
    table = jax.random.uniform(table_key, (3,), minval=0.25, maxval=0.8)
    rgba = rgba.at[model.geom("table").id, :3].set(table)
    names = [name for name in scene.layout.mocap if name.startswith(CLUTTER)]
    colours = jax.random.uniform(colour_key, (len(names), 3))
    for number, name in enumerate(names):
        along_key, aside_key = jax.random.split(jax.random.fold_in(clutter_key, number))
        x = jax.random.uniform(along_key, (), minval=ALONG[0], maxval=ALONG[1])
        y = jax.random.uniform(aside_key, (), minval=ASIDE[0], maxval=ASIDE[1]) * (1 if number % 2 else -1)
        geom = int(model.body_geomadr[model.body(name).id])
        height = _reach_down(model, np.array([geom]))
        places = places.at[scene.layout.mocap[name]].set(jnp.stack([x, y, jnp.float32(TABLE_HEIGHT + height)]))
        rgba = rgba.at[geom, :3].set(colours[number])
    light = start.light.at[:2].set(jax.random.uniform(light_key, (2,), minval=-LIGHT, maxval=LIGHT))
    return replace(
        start, scene=replace(start.scene, geom_rgba=rgba, mocap_pos=places), light=light / jnp.linalg.norm(light)
    )


def other_view(scene: Scene, key: Array, start: Start) -> Start:
    """Moves the front camera on a sphere about the middle of the table, and nearer or farther."""
    around, over, far = jax.random.uniform(key, (3,), minval=-1.0)
    pose = start.camera.world_from_camera
    up = jnp.array([0.0, 0.0, 1.0])
    orbit = quaternion_to_matrix(quaternion_from_axis_angle(up, around * ORBIT))
    tilt = quaternion_to_matrix(quaternion_from_axis_angle(orbit @ pose[:3, 0], over * TILT))
    turn = tilt @ orbit
    position = MIDDLE + (1 + far * DISTANCE) * (turn @ (pose[:3, 3] - MIDDLE))
    moved = pose.at[:3, :3].set(turn @ pose[:3, :3]).at[:3, 3].set(position)
    return replace(start, camera=replace(start.camera, world_from_camera=moved))


_FUNCTIONS: dict[str, Callable[[Scene, Array, Start], Start]] = {
    "instance": other_instance,
    "position": other_position,
    "background": other_background,
    "camera": other_view,
}
SHIFTS = tuple(_FUNCTIONS)


def _is_of_task(model: mujoco.MjModel, geom: int) -> bool:
    name = model.body(model.geom_bodyid[geom]).name
    return name != "world" and not name.startswith(("left_", "right_", CLUTTER))


def _turn_hue(rgb: Array, angle: Array) -> Array:
    grey = jnp.full(3, 3**-0.5)
    return quaternion_to_matrix(quaternion_from_axis_angle(grey, angle)) @ rgb


def _reach_down(model: mujoco.MjModel, geoms: np.ndarray) -> float:
    """How far the geoms of one upright body reach below its origin, metres; about that for tilted ones."""
    half = model.geom_aabb[geoms, 5]
    return float(np.max(half - model.geom_pos[geoms, 2]))
