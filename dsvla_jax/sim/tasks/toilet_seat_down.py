"""Push the raised seat of a toilet down from behind. RLBench: toilet_seat_down."""

import jax
import jax.numpy as jnp
import mujoco

from dsvla_jax.sim.robot import FIXTURE, VISUAL
from dsvla_jax.sim.tasks import task
from dsvla_jax.types import TABLE_HEIGHT, Action, Array

# The root's frame lies under the seat's hinge, which is parallel to y: the bowl is at x > 0, the cistern at x < 0.
HINGE = 0.205  # height, metres
SEAT, TUBE = 0.165, 0.009  # distance of the seat's front from the hinge, and the radius of its rim
RIM = ((0.02, 0.06), (0.115, 0.068), (SEAT, 0.032))  # corners (x, +-y) of the seat when it is down
OPEN_ANGLE, CLOSED_BY = 1.8, 1.7  # radians: how far the seat is raised, and how much less is success
# The expert pushes with closed fingers, over the cistern: distance of its tool centre point from the hinge, how far
# behind the seat it begins and from what height it comes there, half the width of the fingers, the angle at which its
# push ends (from there the seat falls), and how deep it presses the seat down.
RADIUS, CLEARANCE, ABOVE, PAD, PUSHED_ANGLE, PRESS = 0.15, 0.04, 0.1, 0.012, 1.0, 0.01


def _build(spec: mujoco.MjSpec) -> None:
    root = task.add_furniture(spec, "toilet")
    white, shade, water, blue = [0.95, 0.95, 0.96, 1], [0.85, 0.86, 0.88, 1], [0.45, 0.65, 0.8, 1], [0.2, 0.4, 0.7, 1]
    task.add_part(root, "toilet_foot", task.BOX, [0.085, 0.05, 0.05], [0.03, 0, 0.05], shade)
    task.add_part(root, "toilet_bowl", task.ELLIPSOID, [0.105, 0.085, 0.09], [0.085, 0, 0.105], white)
    task.add_part(root, "toilet_rim", task.CYLINDER, [0.078, 0.01], [0.09, 0, 0.185], white)
    task.add_part(root, "toilet_water", task.CYLINDER, [0.055, 0.01], [0.09, 0, 0.187], water)
    task.add_part(root, "toilet_back", task.BOX, [0.05, 0.07, 0.095], [-0.02, 0, 0.097], white)
    task.add_part(root, "toilet_cistern", task.BOX, [0.034, 0.1, 0.055], [-0.075, 0, 0.245], white, FIXTURE)
    task.add_part(root, "toilet_cistern_lid", task.BOX, [0.037, 0.105, 0.006], [-0.077, 0, 0.304], shade)
    task.add_part(root, "toilet_button", task.CYLINDER, [0.015, 0.004], [-0.077, 0, 0.312], [0.4, 0.4, 0.42, 1])
    # One solid collides for the foot and the bowl.
    solid = [0.085, 0.07, 0.095]
    task.add_part(root, "toilet_solid", task.BOX, solid, [0.08, 0, 0.095], white, FIXTURE, group=task.INVISIBLE_GROUP)

    seat = root.add_body(name="toilet_seat", pos=[0, 0, HINGE])
    joint = seat.add_joint(name="toilet_seat", type=task.HINGE, axis=[0, -1, 0], range=[0.0, OPEN_ANGLE], limited=True)
    joint.frictionloss, joint.damping[0], joint.armature = 0.03, 0.01, 0.005
    # A horseshoe of capsules; its sides and its front collide.
    (rear, rear_y), (middle, middle_y), (front, front_y) = RIM
    ends = [((front, front_y), (front, -front_y), FIXTURE), ((rear, rear_y), (rear, -rear_y), VISUAL)]
    for sign in (1, -1):
        ends.append(((rear, sign * rear_y), (middle, sign * middle_y), FIXTURE))
        ends.append(((middle, sign * middle_y), (front, sign * front_y), VISUAL))
    for i, (start, end, bits) in enumerate(ends):
        line = [*start, 0, *end, 0]
        task.add_part(seat, f"toilet_seat{i}", task.CAPSULE, [TUBE], [0, 0, 0], blue, bits, mass=0.04, fromto=line)


def _sample(key: Array, variation: Array) -> task.Placement:
    low, high = jnp.array([0.1, -0.12, -jnp.pi / 4]), jnp.array([0.2, 0.12, jnp.pi / 4])
    x, y, yaw = jax.random.uniform(key, (3,), minval=low, maxval=high)
    return task.Placement(
        mocap={"toilet": task.upright_pose(x, y, TABLE_HEIGHT, yaw)},
        joints={"toilet_seat": jnp.float32(OPEN_ANGLE)},
    )


def _on_seat(view: task.StateView, angle: Array | float, radius: float, outwards: float) -> Array:
    """A world point in the middle plane of the seat raised by ``angle``, ``outwards`` behind the axis of its rim."""
    angle = jnp.asarray(angle)
    x = radius * jnp.cos(angle) - outwards * jnp.sin(angle)
    z = HINGE + radius * jnp.sin(angle) + outwards * jnp.cos(angle)
    return task.point_in_world(view.body_pose("toilet"), jnp.stack([x, 0.0 * angle, z]))


def _keypoints(view: task.StateView) -> Array:
    """The front of the seat, its upper edge while it is raised."""
    return _on_seat(view, view.joint("toilet_seat"), SEAT, 0.0)[None, None]


def _success(view: task.StateView) -> Array:
    return view.joint("toilet_seat") < OPEN_ANGLE - CLOSED_BY


def _expert(view: task.StateView) -> Action:
    behind = _on_seat(view, view.joint("toilet_seat"), RADIUS, TUBE + PAD + CLEARANCE)
    above = behind + jnp.array([0.0, 0.0, ABOVE])
    pushed = _on_seat(view, PUSHED_ANGLE, RADIUS, TUBE + PAD)
    pressed = _on_seat(view, 0.0, SEAT, TUBE - PRESS)
    return task.keyframes([above, behind, pushed, pressed], [task.CLOSED] * 4)


TASK = task.Task(
    name="toilet_seat_down",
    num_arms=1,
    build=_build,
    sample=_sample,
    instructions=(
        "toilet seat down",
        "put the toilet seat down",
        "close the toilet seat",
        "lower the seat of the toilet",
        "push the raised toilet seat down",
    ),
    recognised_by=r"\btoilet\b",
    objects=(task.TaskObject("toilet seat with two parts", r"toilet_seat\d"),),
    keypoints=_keypoints,
    success=_success,
    expert=_expert,
)
