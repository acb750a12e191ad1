"""Turn the minute hand of a clock by its wooden knob to a quarter past twelve. RLBench: change_clock.

The knob is on the minute hand itself, so that knob and dial are seen together.
"""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from dsvla_jax.sim.robot import FIXTURE
from dsvla_jax.sim.tasks import task
from dsvla_jax.types import TABLE_HEIGHT, Action, Array

# The root's frame lies under the dial's middle: +x out of the dial, +y towards three o'clock.
CENTRE, DIAL, FACE = 0.22, 0.095, 0.012  # height and radius of the dial, half its thickness, metres
HAND, KNOB, KNOB_RADIUS, KNOB_TIP = 0.08, 0.055, 0.01, 0.062  # the hand's length; the knob on it: radii, end along x
# Angles of the minute hand, clockwise from twelve, radians: at the start, and to which within what it must be turned.
START, QUARTER, TOLERANCE = (-1.2, -0.2), np.pi / 2, 0.12
# The expert: how far in front of the root and below the knob it holds, so that the palm stays in front of the dial and
# above the knob; from what height it comes; on how many keyframes it turns the hand; and how much farther than to the
# quarter, as the knob slips a little between the fingers.
OUT, BELOW, ABOVE, TURNS, BEYOND = 0.052, 0.01, 0.1, 4, 0.09
FACING = [0.70710678, 0.0, 0.70710678, 0.0]  # a cylinder's axis along x, wxyz


def _build(spec: mujoco.MjSpec) -> None:
    root = task.add_furniture(spec, "clock")
    white, frame, black, wood = [0.96, 0.95, 0.9, 1], [0.15, 0.25, 0.45, 1], [0.08, 0.08, 0.1, 1], [0.75, 0.5, 0.2, 1]
    centre = [0, 0, CENTRE]
    task.add_part(root, "clock_foot", task.BOX, [0.05, 0.06, 0.01], [-0.01, 0, 0.01], frame)
    task.add_part(root, "clock_pole", task.BOX, [0.01, 0.02, CENTRE / 2], [-0.012, 0, CENTRE / 2], frame)
    task.add_part(
        root, "clock_rim", task.CYLINDER, [DIAL + 0.012, FACE - 0.002], [-0.001, 0, CENTRE], frame, quat=FACING
    )
    task.add_part(root, "clock_dial", task.CYLINDER, [DIAL, FACE], centre, white, quat=FACING)
    for hour in range(12):
        angle = np.pi / 6 * hour
        length, width = (0.011, 0.004) if hour % 3 == 0 else (0.006, 0.0025)
        place = [FACE, 0.08 * np.sin(angle), CENTRE + 0.08 * np.cos(angle)]
        turn = [np.cos(angle / 2), -np.sin(angle / 2), 0, 0]
        task.add_part(root, f"clock_mark{hour}", task.BOX, [0.0015, width, length], place, black, quat=turn)
    # A little past twelve.
    hour_hand = {"quat": [np.cos(0.065), -np.sin(0.065), 0, 0]}
    place = [FACE + 0.002, 0.022 * np.sin(0.13), CENTRE + 0.022 * np.cos(0.13)]
    task.add_part(root, "clock_hour", task.BOX, [0.0015, 0.006, 0.028], place, black, **hour_hand)
    # MJX has no contacts between cylinders and the fingers: a box within the dial collides.
    solid = [FACE - 0.002, 0.7 * DIAL, 0.7 * DIAL]
    task.add_part(root, "clock_solid", task.BOX, solid, centre, white, FIXTURE, group=task.INVISIBLE_GROUP)

    hand = root.add_body(name="clock_hand", pos=centre, gravcomp=1.0)
    joint = hand.add_joint(name="clock_hand", type=task.HINGE, axis=[-1, 0, 0])
    joint.frictionloss, joint.damping[0], joint.armature = 0.03, 0.01, 0.005
    red, x = [0.8, 0.1, 0.1, 1], FACE + 0.006
    task.add_part(hand, "clock_minute", task.BOX, [0.0015, 0.004, HAND / 2], [x, 0, HAND / 2], red, mass=0.02)
    task.add_part(hand, "clock_hub", task.CYLINDER, [0.01, 0.005], [x - 0.001, 0, 0], red, mass=0.02, quat=FACING)
    line = [x + 0.008, 0, KNOB, KNOB_TIP, 0, KNOB]
    task.add_part(hand, "clock_knob", task.CAPSULE, [KNOB_RADIUS], [0, 0, 0], wood, FIXTURE, mass=0.02, fromto=line)


def _sample(key: Array, variation: Array) -> task.Placement:
    place_key, time_key = jax.random.split(key)
    # Turned further, the dial could not be read from the front camera.
    low, high = jnp.array([0.08, -0.15, -jnp.pi / 3]), jnp.array([0.22, 0.15, jnp.pi / 3])
    x, y, yaw = jax.random.uniform(place_key, (3,), minval=low, maxval=high)
    angle = jax.random.uniform(time_key, (), minval=START[0], maxval=START[1])
    return task.Placement(mocap={"clock": task.upright_pose(x, y, TABLE_HEIGHT, yaw)}, joints={"clock_hand": angle})


def _at_knob(view: task.StateView, angle: Array | float, out: float, upwards: float = 0.0) -> Array:
    """A world point ``out`` in front of the root and ``upwards`` over the knob's axis, of a hand at ``angle``."""
    angle = jnp.asarray(angle)
    y, z = KNOB * jnp.sin(angle), CENTRE + KNOB * jnp.cos(angle) + upwards
    return task.point_in_world(view.body_pose("clock"), jnp.stack([out + 0.0 * angle, y, z]))


def _keypoints(view: task.StateView) -> Array:
    """The end of the knob, now and when it is a quarter past."""
    angles = (view.joint("clock_hand"), QUARTER)
    return jnp.stack([_at_knob(view, angle, KNOB_TIP) for angle in angles])[None]


def _success(view: task.StateView) -> Array:
    return jnp.abs(view.joint("clock_hand") - QUARTER) < TOLERANCE


def _expert(view: task.StateView) -> Action:
    now = view.joint("clock_hand")
    angles = jnp.linspace(now, QUARTER + BEYOND, TURNS + 1)
    above = _at_knob(view, now, OUT, ABOVE)
    positions = [above, *[_at_knob(view, angle, OUT, -BELOW) for angle in angles]]
    # The fingers open along the dial and the palm is parallel to it; the knob turns between the fingers.
    turn = task.pointing_down(task.yaw_of(view.body_pose("clock")))
    return task.keyframes(positions, [task.OPEN, *[task.CLOSED] * TURNS, task.OPEN], turn)


TASK = task.Task(
    name="change_clock",
    num_arms=1,
    build=_build,
    sample=_sample,
    instructions=(
        "change clock",
        "change the clock to show a quarter past twelve",
        "set the clock to 12 15",
        "turn the wooden knob until the clock shows a quarter past twelve",
        "move the minute hand of the clock to the three",
    ),
    recognised_by=r"\bclock\b",
    objects=(task.TaskObject("wooden button", "clock_knob"),),
    keypoints=_keypoints,
    success=_success,
    expert=_expert,
)
