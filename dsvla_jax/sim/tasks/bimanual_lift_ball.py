"""Squeeze a ball between two arms and lift it. RLBench (two arms): bimanual_lift_ball."""

import jax
import jax.numpy as jnp
import mujoco

from dsvla_jax.sim.robot import OBJECT
from dsvla_jax.sim.tasks import task
from dsvla_jax.types import TABLE_HEIGHT, Action, Array

RADIUS = 0.1
LIFTED = 0.95  # height of the ball's centre, metres
# Straight down and turned by a quarter, so that an open gripper meets the ball with the sides of both its fingers.
SIDEWAYS = (0.70710678, -0.70710678, 0.0, 0.0)
# The keyframes of each arm: distance from the ball's centre along y, and height over it.
KEYFRAMES = ((0.22, -0.01), (0.15, -0.01), (0.08, -0.01), (0.08, 0.24))


def _build(spec: mujoco.MjSpec) -> None:
    ball = task.add_object(spec, "ball", RADIUS, damping=1e-3)
    orange = [0.9, 0.45, 0.1, 1]
    task.add_part(ball, "ball", task.SPHERE, [RADIUS], [0, 0, 0], orange, OBJECT, mass=0.15)


def _sample(key: Array, variation: Array) -> task.Placement:
    low, high = jnp.array([0.08, -0.06, -jnp.pi / 8]), jnp.array([0.2, 0.06, jnp.pi / 8])
    x, y, yaw = jax.random.uniform(key, (3,), minval=low, maxval=high)
    return task.Placement(free={"ball": task.upright_pose(x, y, TABLE_HEIGHT + RADIUS, yaw)})


def _keypoints(view: task.StateView) -> Array:
    """The middle of the ball, for both arms."""
    return jnp.broadcast_to(view.body_pose("ball")[:3], (2, 1, 3))


def _success(view: task.StateView) -> Array:
    return view.body_pose("ball")[2] >= LIFTED


def _expert(view: task.StateView) -> Action:
    # A plain ball does not show how it is turned: the arms come along the world's y axis.
    centre = view.body_pose("ball")[:3]
    sideways, height = jnp.asarray(KEYFRAMES, jnp.float32).T
    offsets = jnp.stack([jnp.zeros_like(sideways), sideways, height], axis=-1)
    mirrored = offsets * jnp.array([1.0, -1.0, 1.0])
    left = task.keyframes(centre + offsets, [task.OPEN] * len(KEYFRAMES), SIDEWAYS)
    right = task.keyframes(centre + mirrored, [task.OPEN] * len(KEYFRAMES), SIDEWAYS)
    return task.both_arms(left, right)


TASK = task.Task(
    name="bimanual_lift_ball",
    num_arms=2,
    build=_build,
    sample=_sample,
    instructions=(
        "lift the ball",
        "lift the ball with both arms",
        "pick up the ball using two arms",
        "squeeze the ball between the arms and lift it up",
        "raise the ball off the table",
    ),
    recognised_by=r"\bball\b",
    objects=(task.TaskObject("ball", "ball"),),
    keypoints=_keypoints,
    success=_success,
    expert=_expert,
    resizable=("ball",),
)
