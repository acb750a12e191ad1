"""Push a wide parcel onto a red square with both arms side by side. RLBench (two arms): bimanual_push_box."""

import jax
import jax.numpy as jnp
import mujoco

from dsvla_jax.sim.robot import OBJECT
from dsvla_jax.sim.tasks import task
from dsvla_jax.types import TABLE_HEIGHT, Action, Array

# Half extents of the parcel, metres. It is so low that the palms of the hands that push it pass over it.
DEPTH, WIDTH, HEIGHT = 0.09, 0.18, 0.045
# In the frame of the root, whose x axis points away from the robot: the middles of the parcel and of the square.
PARCEL, SQUARE = -0.11, 0.12
SIDE, NEAR = 0.1, 0.05  # half an edge of the square; how far from its middle the parcel's may end up
# The expert: how far to each side of the middle the hands push, their height over the table, how far behind the
# parcel they begin, and the half thickness of a finger.
HAND, PUSH_HEIGHT, CLEARANCE, PAD = 0.13, 0.056, 0.06, 0.01


def _build(spec: mujoco.MjSpec) -> None:
    square = task.add_furniture(spec, "target")
    task.add_part(square, "target", task.BOX, [SIDE, SIDE, 0.001], [0, 0, 0.001], [0.85, 0.1, 0.1, 1])

    # It slides without turning over, and stops where it is let go.
    parcel = task.add_object(spec, "box", HEIGHT)
    card, tape = [0.72, 0.53, 0.32, 1], [0.87, 0.78, 0.6, 1]
    task.add_part(parcel, "box", task.BOX, [DEPTH, WIDTH, HEIGHT], [0, 0, 0], card, OBJECT, mass=1.5)
    task.add_part(parcel, "box_tape", task.BOX, [0.015, WIDTH + 0.001, HEIGHT + 0.001], [0, 0, 0], tape, mass=0)
    label = [0.03, 0.045, 0.002]
    task.add_part(parcel, "box_label", task.BOX, label, [0.05, -0.09, HEIGHT], [0.95, 0.95, 0.95, 1])


def _sample(key: Array, variation: Array) -> task.Placement:
    # The square stays within reach of both arms: the push is shorter than RLBench's 0.58 m.
    low, high = jnp.array([0.23, -0.05, -jnp.pi / 18]), jnp.array([0.29, 0.05, jnp.pi / 18])
    x, y, yaw = jax.random.uniform(key, (3,), minval=low, maxval=high)
    root = task.upright_pose(x, y, TABLE_HEIGHT, yaw)
    box, square = (task.point_in_world(root, (along, 0.0, 0.0)) for along in (PARCEL, SQUARE))
    return task.Placement(
        mocap={"target": task.upright_pose(square[0], square[1], square[2], yaw)},
        free={"box": task.upright_pose(box[0], box[1], TABLE_HEIGHT + HEIGHT, yaw)},
    )


def _keypoints(view: task.StateView) -> Array:
    """For each arm the place on the parcel's rear edge that it pushes, then the middle of the square."""
    box, square = view.body_pose("box"), view.body_pose("target")
    destination = task.point_in_world(square, (0.0, 0.0, 0.002))
    return jnp.stack(
        [jnp.stack([task.point_in_world(box, (-DEPTH, y, HEIGHT)), destination]) for y in (HAND, -HAND)],
    )


def _success(view: task.StateView) -> Array:
    """The middle of the parcel is near the square's."""
    offset = task.point_in_body(view.body_pose("target"), view.body_pose("box")[:3])
    return jnp.all(jnp.abs(offset[:2]) < NEAR)


def _expert(view: task.StateView) -> Action:
    box, square = view.body_pose("box"), view.body_pose("target")
    turn = task.pointing_down(task.yaw_of(square))
    contact, arms = -DEPTH - PAD, []
    for y in (HAND, -HAND):
        behind = task.point_in_world(box, (contact - CLEARANCE, y, PUSH_HEIGHT - HEIGHT))
        pushed = task.point_in_world(square, (contact, y, PUSH_HEIGHT))
        arms.append(task.keyframes([behind, pushed], [task.OPEN, task.OPEN], turn))
    return task.both_arms(*arms)


TASK = task.Task(
    name="bimanual_push_box",
    num_arms=2,
    build=_build,
    sample=_sample,
    instructions=(
        "push the box to the red area",
        "push the box onto the red square",
        "use both arms to push the box to the red square",
        "slide the heavy box onto the red target",
        "push the box to the red area with both hands",
    ),
    recognised_by=r"\b(push|slide) (the )?(heavy )?box\b|push the box",
    objects=(
        task.TaskObject("box", "box.*"),
        task.TaskObject("red square", "target"),
    ),
    keypoints=_keypoints,
    success=_success,
    expert=_expert,
    colours_matter=True,
)
