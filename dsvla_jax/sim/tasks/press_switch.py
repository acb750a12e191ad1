"""Flick the lever of a switch on an upright board. RLBench: press_switch."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from dsvla_jax.sim.robot import FIXTURE
from dsvla_jax.sim.tasks import task
from dsvla_jax.types import TABLE_HEIGHT, Action, Array

# The root's frame lies under the lever's hinge: +x out of the board, y along it.
SWITCH, BOARD = 0.2, (0.15, 0.28)  # height of the switch; half the board's width and its height, metres
LEVER, RADIUS = 0.06, 0.009  # the lever's length and radius
OFF, FLICKED = -0.6, 1.0  # the lever's angle at the start, and how far it must turn, radians
# The expert sweeps closed fingers along the board: how far in front of the board and below the lever, so that the palm
# stays above it, and where along the board the sweep begins and ends.
OUT, BELOW, BEGIN, END, ABOVE = 0.04, 0.015, -0.085, 0.006, 0.1


def _build(spec: mujoco.MjSpec) -> None:
    root = task.add_furniture(spec, "switch")
    wood, white, grey, red = [0.8, 0.75, 0.62, 1], [0.96, 0.96, 0.96, 1], [0.35, 0.35, 0.38, 1], [0.85, 0.12, 0.1, 1]
    half, height = BOARD
    board = [0.01, half, height / 2]
    task.add_part(root, "switch_board", task.BOX, board, [-0.01, 0, height / 2], wood, FIXTURE)
    for i, sign in enumerate((-1, 1)):
        task.add_part(root, f"switch_foot{i}", task.BOX, [0.05, 0.012, 0.008], [-0.01, sign * 0.12, 0.008], grey)
        screw = {"quat": [0.70710678, 0, 0.70710678, 0]}
        place = [0.004, 0, SWITCH + 0.04 * sign]
        task.add_part(root, f"switch_screw{i}", task.CYLINDER, [0.005, 0.003], place, grey, **screw)
    task.add_part(root, "switch_plate", task.BOX, [0.005, 0.045, 0.055], [0, 0, SWITCH], white)
    task.add_part(root, "switch_socket", task.BOX, [0.005, 0.026, 0.016], [0.003, 0, SWITCH], grey)

    lever = root.add_body(name="switch_lever", pos=[0, 0, SWITCH])
    joint = lever.add_joint(name="switch_lever", type=task.HINGE, axis=[0, 0, 1], range=[OFF, 0.8], limited=True)
    joint.frictionloss, joint.damping[0], joint.armature = 0.02, 0.01, 0.005
    line = [0.005, 0, 0, LEVER, 0, 0]
    task.add_part(lever, "switch_lever", task.CAPSULE, [RADIUS], [0, 0, 0], red, FIXTURE, mass=0.05, fromto=line)


def _sample(key: Array, variation: Array) -> task.Placement:
    # Turned further, the board would hide the lever from the front camera.
    low, high = jnp.array([0.1, -0.12, -jnp.pi / 2]), jnp.array([0.24, 0.12, jnp.pi / 2])
    x, y, yaw = jax.random.uniform(key, (3,), minval=low, maxval=high)
    return task.Placement(
        mocap={"switch": task.upright_pose(x, y, TABLE_HEIGHT, yaw)}, joints={"switch_lever": jnp.float32(OFF)}
    )


def _keypoints(view: task.StateView) -> Array:
    """The tip of the lever."""
    angle = view.joint("switch_lever")
    tip = jnp.stack([LEVER * jnp.cos(angle), LEVER * jnp.sin(angle), jnp.float32(SWITCH)])
    return task.point_in_world(view.body_pose("switch"), tip)[None, None]


def _success(view: task.StateView) -> Array:
    return view.joint("switch_lever") > OFF + FLICKED


def _expert(view: task.StateView) -> Action:
    switch = view.body_pose("switch")
    low = SWITCH - BELOW
    places = np.array([[OUT, BEGIN, low + ABOVE], [OUT, BEGIN, low], [OUT, END, low]])
    positions = [task.point_in_world(switch, place) for place in places]
    # The palm is parallel to the board.
    return task.keyframes(positions, [task.CLOSED] * 3, task.pointing_down(task.yaw_of(switch)))


TASK = task.Task(
    name="press_switch",
    num_arms=1,
    build=_build,
    sample=_sample,
    instructions=(
        "press switch",
        "flick the switch",
        "turn the switch on",
        "push the lever of the switch to the other side",
        "flip the red switch on the board",
    ),
    recognised_by=r"\bswitch\b",
    objects=(task.TaskObject("switch button", "switch_lever"),),
    keypoints=_keypoints,
    success=_success,
    expert=_expert,
    colours_matter=True,
)
