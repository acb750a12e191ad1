"""Take a broom from its stand and sweep five pieces of dirt into a dustpan. RLBench: sweep_to_dustpan."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from dsvla_jax.sim.robot import OBJECT, CollisionBits
from dsvla_jax.sim.tasks import task
from dsvla_jax.types import TABLE_HEIGHT, Action, Array

# Dirt is hit by the table and by the broom, not by fingers or other dirt, which would cost contacts at every step.
DIRT_BITS = CollisionBits(0, 3)
DIRT = 0.011  # radius, metres
DIRTS = tuple(f"dirt{i}" for i in range(5))
# In the frame of the root, metres: where the pieces of dirt lie, each moved by up to JITTER an axis.
PLACES = np.array([[-0.04, 0.05], [0.04, 0.05], [0.0, 0.02], [-0.035, -0.015], [0.035, -0.015]], np.float32)
JITTER = 0.012
PAN, PAN_HALF = (0.0, -0.165), (0.1, 0.075)  # the middle of the dustpan, and half its width and depth
STAND = (-0.13, 0.14)  # where the broom waits
# The broom: its origin is at the bottom. The head's half width, half thickness and height; the handle's radius and top.
HEAD, HANDLE, TOP = (0.075, 0.014, 0.05), 0.011, 0.24
GRASP, HOVER, APPROACH = 0.21, 0.003, 0.1  # heights of the grasp, of the waiting broom and of the hand's approach
SWEEP_FROM, SWEEP_TO = 0.115, -0.13  # where along y the broom begins and ends


def _build(spec: mujoco.MjSpec) -> None:
    pan = task.add_furniture(spec, "dustpan")
    dark, wood, straw = [0.2, 0.22, 0.28, 1], [0.3, 0.16, 0.08, 1], [0.85, 0.7, 0.35, 1]
    x, y = PAN_HALF
    task.add_part(pan, "dustpan_floor", task.BOX, [x, y, 0.001], [0, 0, 0.001], dark)
    task.add_part(pan, "dustpan_back", task.BOX, [x, 0.004, 0.022], [0, -y, 0.022], dark)
    for i, side in enumerate((x, -x)):
        task.add_part(pan, f"dustpan_side{i}", task.BOX, [0.004, y + 0.003, 0.018], [side, 0, 0.018], dark)
    handle = {"fromto": [0, -y - 0.01, 0.025, 0, -y - 0.1, 0.035]}
    task.add_part(pan, "dustpan_handle", task.CAPSULE, [0.012], [0, 0, 0], dark, **handle)

    # The broom is attached to its stand until it is grasped.
    stand = task.add_furniture(spec, "broom_stand")
    grey = [0.6, 0.62, 0.65, 1]
    task.add_part(stand, "broom_stand_foot", task.BOX, [0.04, 0.025, 0.006], [0, 0.055, 0.006], grey)
    task.add_part(stand, "broom_stand_post", task.BOX, [0.007, 0.007, 0.08], [0, 0.05, 0.085], grey)
    task.add_part(stand, "broom_stand_arm", task.BOX, [0.02, 0.02, 0.006], [0, 0.025, 0.16], grey)

    broom = task.add_object(spec, "broom", HOVER)
    wide, thick, high = HEAD
    box = [wide, thick, high / 2]
    task.add_part(broom, "broom_head", task.BOX, box, [0, 0, high / 2], straw, OBJECT, mass=0.05)
    task.add_part(broom, "broom_bar", task.BOX, [wide + 0.002, thick + 0.002, 0.012], [0, 0, high], wood)
    handle = {"fromto": [0, 0, high, 0, 0, TOP - HANDLE], "mass": 0.05}
    task.add_part(broom, "broom_handle", task.CAPSULE, [HANDLE], [0, 0, 0], wood, OBJECT, **handle)

    for name in DIRTS:
        # So much damping that a piece slides on by a few centimetres at most when the broom stops.
        dirt = task.add_object(spec, name, DIRT, damping=0.2)
        task.add_part(dirt, name, task.SPHERE, [DIRT], [0, 0, 0], [0.12, 0.08, 0.06, 1], DIRT_BITS, mass=0.01)


def _sample(key: Array, variation: Array) -> task.Placement:
    place_key, dirt_key = jax.random.split(key)
    low, high = jnp.array([0.14, -0.08, -jnp.pi]), jnp.array([0.2, 0.08, jnp.pi])
    x, y, yaw = jax.random.uniform(place_key, (3,), minval=low, maxval=high)
    root = task.upright_pose(x, y, TABLE_HEIGHT, yaw)

    def at(place: Array, height: float) -> Array:
        return root.at[:3].set(task.point_in_world(root, jnp.append(jnp.asarray(place, jnp.float32), height)))

    places = jnp.asarray(PLACES) + jax.random.uniform(dirt_key, PLACES.shape, minval=-JITTER, maxval=JITTER)
    dirt = {name: at(place, DIRT) for name, place in zip(DIRTS, places, strict=True)}
    furniture = {"dustpan": at(jnp.asarray(PAN), 0.0), "broom_stand": at(jnp.asarray(STAND), 0.0)}
    return task.Placement(mocap=furniture, free={"broom": at(jnp.asarray(STAND), HOVER), **dirt})


def _keypoints(view: task.StateView) -> Array:
    """The upper end of the broom's handle, the middle of the dirt, then the middle of the dustpan."""
    handle = task.point_in_world(view.body_pose("broom"), (0.0, 0.0, GRASP))
    dirt = jnp.mean(jnp.stack([view.body_pose(name)[:3] for name in DIRTS]), axis=0)
    return jnp.stack([handle, dirt, task.point_in_world(view.body_pose("dustpan"), (0.0, 0.0, DIRT))])[None]


def _success(view: task.StateView) -> Array:
    """All pieces of dirt are on the dustpan."""
    pan = view.body_pose("dustpan")
    dirt = jnp.stack([task.point_in_body(pan, view.body_pose(name)[:3]) for name in DIRTS])
    return jnp.all((jnp.abs(dirt[:, :2]) < jnp.array(PAN_HALF)) & (dirt[:, 2:] < HEAD[2]))


def _expert(view: task.StateView) -> Action:
    pan, broom = view.body_pose("dustpan"), view.body_pose("broom")
    handle = task.point_in_world(broom, (0.0, 0.0, GRASP))
    # The broom keeps its height and its turn, which is the dustpan's.
    ends = [task.point_in_world(pan, (0.0, y - PAN[1], GRASP + HOVER)) for y in (SWEEP_FROM, SWEEP_TO)]
    grippers = [task.OPEN, task.CLOSED, task.CLOSED, task.CLOSED]
    positions = [handle.at[2].add(APPROACH), handle, *ends]
    return task.keyframes(positions, grippers, task.pointing_down(task.yaw_of(pan)))


TASK = task.Task(
    name="sweep_to_dustpan",
    num_arms=1,
    build=_build,
    sample=_sample,
    instructions=(
        "sweep dirt to dustpan",
        "sweep the dirt up into the dustpan",
        "use the broom to brush the dirt into the dustpan",
        "take the broom and clean up the dirt",
        "pick up the brush and sweep the table",
    ),
    recognised_by=r"\b(sweep|dust|dirt|dustpan|broom)\b",
    objects=(
        task.TaskObject("the dark brown long pole with two parts", "broom_(head|bar|handle)"),
        task.TaskObject("bigger dark dustpan", "dustpan_.*"),
    ),
    keypoints=_keypoints,
    success=_success,
    expert=_expert,
    graspables=(task.Graspable("broom", (HANDLE, HANDLE, 0.04), (0.0, 0.0, 0.2)),),
    attachments=(task.Attachment("broom", "broom_stand", (0.0, 0.0, HOVER)),),
    release=lambda view: view.holds("broom"),
    resizable=DIRTS,
)
