"""Slide a wand's ring along a wire, without touching it, off its right end. RLBench: beat_the_buzz."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from dsvla_jax.geometry import rotations
from dsvla_jax.sim.robot import OBJECT, VISUAL
from dsvla_jax.sim.tasks import task
from dsvla_jax.types import TABLE_HEIGHT, Action, Array

# The wire, metres, in the frame of the root: along the y axis at HEIGHT, from a post on the left to its free end.
HEIGHT, POST, END, WIRE = 0.12, 0.15, -0.06, 0.005
START = 0.09  # where along the wire the wand waits
# The wand: its origin is the middle of the ring, whose axis is y; the handle stands on the ring.
RING, TUBE, HANDLE, SEGMENTS = 0.04, 0.005, 0.011, 10
HANDLE_LOW, HANDLE_HIGH, GRASP = 0.052, 0.11, 0.09
CLEARANCE = RING - TUBE - WIRE  # between the middles of ring and wire; further apart, they touch
# Success: the ring has left the wire and has been let go at most this far beyond its end, and this far aside.
BEYOND, ASIDE = 0.16, 0.06
APPROACH, LEAVE = 0.1, END - 0.06  # the expert's height over its grasp, and where along the wire's line it lets go


def _build(spec: mujoco.MjSpec) -> None:
    root = task.add_furniture(spec, "buzz")
    copper, board, rest = [0.85, 0.5, 0.25, 1], [0.15, 0.25, 0.5, 1], [0.85, 0.85, 0.85, 1]
    task.add_part(root, "buzz_board", task.BOX, [0.06, 0.105, 0.012], [0, 0.07, 0.012], board)
    post = {"fromto": [0, POST, 0.02, 0, POST, HEIGHT]}
    task.add_part(root, "buzz_post", task.CAPSULE, [WIRE], [0, 0, 0], copper, **post)
    wire = {"fromto": [0, POST, HEIGHT, 0, END, HEIGHT]}
    task.add_part(root, "buzz_wire", task.CAPSULE, [WIRE], [0, 0, 0], copper, **wire)
    # The rest under the waiting ring; the wand is attached there until it is grasped.
    top = (HEIGHT - RING) / 2
    task.add_part(root, "buzz_rest", task.BOX, [0.02, 0.01, top - 0.011], [0, START, top + 0.011], rest)

    wand = task.add_object(spec, "wand", HEIGHT, damping=1e-3)
    orange, steel = [0.95, 0.45, 0.05, 1], [0.2, 0.2, 0.22, 1]
    angles = -np.pi / 2 + (np.arange(SEGMENTS + 1) - 0.5) * 2 * np.pi / SEGMENTS
    corners = np.stack([np.cos(angles), 0 * angles, np.sin(angles)], axis=-1) * RING
    for i in range(SEGMENTS):
        # Of the ring, the lowest segment collides: it lies on the table with the handle.
        bits = OBJECT if i == 0 else VISUAL
        segment = {"fromto": [*corners[i], *corners[i + 1]], "mass": 0.005}
        task.add_part(wand, f"wand_ring{i}", task.CAPSULE, [TUBE], [0, 0, 0], steel, bits, **segment)
    neck = {"fromto": [0, 0, RING, 0, 0, HANDLE_LOW]}
    task.add_part(wand, "wand_neck", task.CAPSULE, [TUBE], [0, 0, 0], steel, **neck)
    handle = {"fromto": [0, 0, HANDLE_LOW + HANDLE, 0, 0, HANDLE_HIGH], "mass": 0.05}
    task.add_part(wand, "wand_handle", task.CAPSULE, [HANDLE], [0, 0, 0], orange, OBJECT, **handle)


def _sample(key: Array, variation: Array) -> task.Placement:
    low, high = jnp.array([0.13, -0.1, -jnp.pi]), jnp.array([0.21, 0.1, jnp.pi])
    x, y, yaw = jax.random.uniform(key, (3,), minval=low, maxval=high)
    root = task.upright_pose(x, y, TABLE_HEIGHT, yaw)
    wand = root.at[:3].set(task.point_in_world(root, (0.0, START, HEIGHT)))
    return task.Placement(mocap={"buzz": root}, free={"wand": wand})


def _keypoints(view: task.StateView) -> Array:
    """The handle of the wand, then the free end of the wire."""
    handle = task.point_in_world(view.body_pose("wand"), (0.0, 0.0, GRASP))
    return jnp.stack([handle, task.point_in_world(view.body_pose("buzz"), (0.0, END, HEIGHT))])[None]


def _success(view: task.StateView) -> Array:
    x, y, z = task.point_in_body(view.body_pose("buzz"), view.body_pose("wand")[:3])
    beyond = (y < END - WIRE - TUBE) & (y > END - BEYOND) & (jnp.abs(x) < ASIDE) & (z < HEIGHT + ASIDE)
    return beyond & view.holds_nothing()


def _touches(view: task.StateView) -> Array:
    """Whether the wire's line meets the plane of the ring outside its hole, anywhere left of the wire's free end."""
    root, wand = view.body_pose("buzz"), view.body_pose("wand")
    point = task.point_in_body(wand, task.point_in_world(root, (0.0, 0.0, HEIGHT)))
    line = rotations.quaternion_multiply(rotations.quaternion_conjugate(wand[3:]), root[3:])
    direction = rotations.quaternion_rotate(line, jnp.array([0.0, 1.0, 0.0]))
    steep = jnp.where(jnp.abs(direction[1]) < 1e-3, 1e-3, direction[1])
    along = -point[1] / steep
    meets = point + along * direction
    return (along > END - WIRE) & (jnp.hypot(meets[0], meets[2]) > CLEARANCE)


def _expert(view: task.StateView) -> Action:
    root = view.body_pose("buzz")
    grasp = task.point_in_world(view.body_pose("wand"), (0.0, 0.0, GRASP))
    leave = task.point_in_world(root, (0.0, LEAVE, HEIGHT + GRASP))
    grippers = [task.OPEN, task.CLOSED, task.OPEN]
    return task.keyframes([grasp.at[2].add(APPROACH), grasp, leave], grippers, task.pointing_down(task.yaw_of(root)))


TASK = task.Task(
    name="beat_the_buzz",
    num_arms=1,
    build=_build,
    sample=_sample,
    instructions=(
        "beat the buzz",
        "slide the ring along the wire without touching it",
        "take the wand by its handle and move it off the end of the wire",
        "move the ring from the left end to the right end of the wire without touching it",
    ),
    recognised_by=r"\bbuzz\b|\bwand\b|\bring\b",
    objects=(task.TaskObject("orange handle", "wand_handle"),),
    keypoints=_keypoints,
    success=_success,
    expert=_expert,
    failure=_touches,
    graspables=(task.Graspable("wand", (HANDLE, HANDLE, 0.035), (0.0, 0.0, 0.085)),),
    attachments=(task.Attachment("wand", "buzz", (0.0, START, HEIGHT)),),
    release=lambda view: view.holds("wand"),
)
