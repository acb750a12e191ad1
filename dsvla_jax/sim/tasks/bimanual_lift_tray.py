"""Lift a tray by both its handles without losing what lies on it. RLBench (two arms): bimanual_lift_tray."""

import jax
import jax.numpy as jnp
import mujoco

from dsvla_jax.sim.robot import CollisionBits
from dsvla_jax.sim.tasks import task
from dsvla_jax.types import TABLE_HEIGHT, Action, Array

STAND = 0.1  # height, metres
# Half extents of the tray's floor and of the item; a handle's distance from the middle, half length and radius.
LENGTH, WIDTH, FLOOR, ITEM = 0.09, 0.15, 0.006, 0.022
HANDLE, HANDLE_HALF, HANDLE_RADIUS = 0.19, 0.05, 0.01
LIFTED = 1.2  # height of the tray and of the item, metres
# The arms lean this far outwards from straight down, which keeps the hands beside the tray, and so the item in view.
LEAN = 0.7
# The keyframes over a handle: how far outwards and how high. Lifted at once, the item would take off as the tray stops.
KEYFRAMES = ((0.06, 0.06), (0.0, 0.0), (0.0, 0.19), (0.0, 0.38))

# The hands meet the handles alone: more pairs that collide would cost time at every step.
STAND_BITS, FLOOR_BITS, ITEM_BITS = CollisionBits(8, 0), CollisionBits(8, 9), CollisionBits(0, 9)
HANDLE_BITS = CollisionBits(0, 4)


def _build(spec: mujoco.MjSpec) -> None:
    stand = task.add_furniture(spec, "stand")
    pine, oak, steel = [0.8, 0.68, 0.5, 1], [0.45, 0.25, 0.13, 1], [0.75, 0.77, 0.8, 1]
    task.add_part(stand, "stand", task.BOX, [0.07, 0.11, STAND / 2], [0, 0, STAND / 2], pine, STAND_BITS)
    for i, z in enumerate((0.03, 0.07)):
        task.add_part(stand, f"stand_drawer{i}", task.BOX, [0.002, 0.1, 0.015], [0.071, 0, z], [0.7, 0.56, 0.38, 1])
        task.add_part(stand, f"stand_knob{i}", task.SPHERE, [0.007], [0.077, 0, z], steel)

    tray = task.add_object(spec, "tray", STAND + FLOOR)
    task.add_part(tray, "tray", task.BOX, [LENGTH, WIDTH, FLOOR], [0, 0, 0], oak, FLOOR_BITS, mass=0.4)
    rim = [0.35, 0.18, 0.09, 1]
    for sign, side in ((1, "left"), (-1, "right")):
        task.add_part(tray, f"tray_front_{side}", task.BOX, [0.005, WIDTH, 0.012], [sign * LENGTH, 0, 0.008], rim)
        task.add_part(tray, f"tray_{side}", task.BOX, [LENGTH - 0.004, 0.005, 0.012], [0, sign * WIDTH, 0.008], rim)
        bar = {"quat": [0.70710678, 0, 0.70710678, 0], "mass": 0.05}
        size = [HANDLE_RADIUS, HANDLE_HALF]
        task.add_part(tray, f"tray_handle_{side}", task.CAPSULE, size, [0, sign * HANDLE, 0], steel, HANDLE_BITS, **bar)
        for i, x in enumerate((-HANDLE_HALF, HANDLE_HALF)):
            reach = (HANDLE - WIDTH) / 2
            task.add_part(
                tray, f"tray_arm_{side}{i}", task.BOX, [0.006, reach, 0.005], [x, sign * (HANDLE - reach), 0], steel
            )

    item = task.add_object(spec, "item", STAND + 2 * FLOOR + ITEM)
    task.add_part(item, "item", task.BOX, [ITEM] * 3, [0, 0, 0], [0.95, 0.75, 0.1, 1], ITEM_BITS, mass=0.05)


def _sample(key: Array, variation: Array) -> task.Placement:
    place_key, item_key = jax.random.split(key)
    low, high = jnp.array([0.1, -0.05, -jnp.pi / 8]), jnp.array([0.22, 0.05, jnp.pi / 8])
    x, y, yaw = jax.random.uniform(place_key, (3,), minval=low, maxval=high)
    stand = task.upright_pose(x, y, TABLE_HEIGHT, yaw)
    spot = jax.random.uniform(item_key, (2,), minval=-1.0) * jnp.array([0.04, 0.08])
    item = task.point_in_world(stand, jnp.append(spot, STAND + 2 * FLOOR + ITEM))
    tray = task.upright_pose(x, y, TABLE_HEIGHT + STAND + FLOOR, yaw)
    return task.Placement(
        mocap={"stand": stand}, free={"tray": tray, "item": task.upright_pose(item[0], item[1], item[2], yaw)}
    )


def _keypoints(view: task.StateView) -> Array:
    """For each arm the middle of its handle."""
    tray = view.body_pose("tray")
    return jnp.stack([task.point_in_world(tray, (0.0, y, 0.0)) for y in (HANDLE, -HANDLE)])[:, None]


def _success(view: task.StateView) -> Array:
    """Both hands hold the tray, and it and the item are high."""
    high = jnp.stack([view.body_pose(name)[2] >= LIFTED for name in ("tray", "item")])
    return jnp.all(high) & jnp.all(view.held)


def _expert(view: task.StateView) -> Action:
    tray = view.body_pose("tray")
    outwards, height = jnp.asarray(KEYFRAMES, jnp.float32).T
    arms = []
    for sign in (1.0, -1.0):
        offsets = jnp.stack([jnp.zeros_like(outwards), sign * (HANDLE + outwards), height], axis=-1)
        positions = jax.vmap(lambda offset: task.point_in_world(tray, offset))(offsets)
        grippers = [task.OPEN, task.CLOSED, task.CLOSED, task.CLOSED]
        arms.append(task.keyframes(positions, grippers, task.leaning(-sign * LEAN, task.yaw_of(tray))))
    return task.both_arms(*arms)


TASK = task.Task(
    name="bimanual_lift_tray",
    num_arms=2,
    build=_build,
    sample=_sample,
    instructions=(
        "lift the tray",
        "lift the tray by both its handles",
        "pick up the tray with both arms",
        "raise the tray with the yellow block on it",
        "take the tray off the stand and hold it up level",
    ),
    recognised_by=r"\b(lift|raise|pick up|take) (the )?tray\b",
    objects=(task.TaskObject("tray", "tray.*"),),
    keypoints=_keypoints,
    success=_success,
    expert=_expert,
    graspables=(task.Graspable("tray", (LENGTH, HANDLE + HANDLE_RADIUS, HANDLE_RADIUS)),),
    rests_on={"tray": "stand", "item": "tray"},
    resizable=("item",),
    colours_matter=True,
)
