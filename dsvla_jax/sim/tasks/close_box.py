"""Take the open lid of a box by its edge and swing it shut. RLBench: close_box.

The lid opens to the robot's left, where the hand can come along it from the side: at such slants the arm's reach is
much larger sideways than forwards.
"""

import jax
import jax.numpy as jnp
import mujoco

from dsvla_jax.geometry import rotations
from dsvla_jax.sim.robot import FIXTURE
from dsvla_jax.sim.tasks import task
from dsvla_jax.types import TABLE_HEIGHT, Action, Array

# The root's frame lies under the hinge, which is parallel to x: the box is at y < 0, the open lid at y > 0.
WIDTH, LENGTH, HEIGHT, WALL = 0.2, 0.15, 0.11, 0.005  # along x, y and z, and half the thickness of a wall, metres
LID = 0.005  # half the lid's thickness
OPEN_ANGLE, CLOSED_BY = 2.7, 2.6  # radians: how far the lid stands open, and how much less is success
# The expert: where it holds the lid, distance from the hinge; how far it begins and ends beyond the edge; and the
# lid's angles on the way, of which the last leans so far over the box that the lid falls shut when it is let go.
GRASP, CLEARANCE = LENGTH - 0.018, 0.09
ANGLES = (2.7, 2.1, 1.5, 0.95)


def _build(spec: mujoco.MjSpec) -> None:
    root = task.add_furniture(spec, "box")
    brown, light, dark = [0.85, 0.65, 0.38, 1], [0.95, 0.86, 0.68, 1], [0.55, 0.35, 0.18, 1]
    y, z = -LENGTH / 2, HEIGHT / 2
    end = [WALL, LENGTH / 2, z]
    side = [WIDTH / 2 - 2 * WALL, WALL, z]
    for i, sign in enumerate((-1, 1)):
        task.add_part(root, f"box_end{i}", task.BOX, end, [sign * (WIDTH / 2 - WALL), y, z], brown)
        task.add_part(root, f"box_side{i}", task.BOX, side, [0, y + sign * (LENGTH / 2 - WALL), z], brown)
    task.add_part(root, "box_bottom", task.BOX, [WIDTH / 2, LENGTH / 2, 0.003], [0, y, 0.003], dark)
    # One solid collides for all walls: nothing needs to reach into the box.
    solid = [WIDTH / 2, LENGTH / 2, z]
    task.add_part(root, "box_solid", task.BOX, solid, [0, y, z], brown, FIXTURE, group=task.INVISIBLE_GROUP)

    lid = root.add_body(name="box_lid", pos=[0, 0, HEIGHT])
    joint = lid.add_joint(name="box_lid", type=task.HINGE, axis=[-1, 0, 0], range=[0.0, OPEN_ANGLE], limited=True)
    joint.damping[0], joint.armature = 0.01, 0.005
    x = WIDTH / 2
    lining, tape = [x - 0.012, LENGTH / 2 - 0.012, LID], [x - 0.001, 0.012, LID]
    task.add_part(lid, "box_lid", task.BOX, [x, LENGTH / 2, LID], [0, y, LID], brown, FIXTURE, mass=0.2)
    task.add_part(lid, "box_lid_lining", task.BOX, lining, [0, y, LID - 0.001], light, mass=0)
    task.add_part(lid, "box_lid_tape", task.BOX, tape, [0, y, LID + 0.001], dark, mass=0)


def _sample(key: Array, variation: Array) -> task.Placement:
    low, high = jnp.array([0.1, -0.08, -jnp.pi / 8]), jnp.array([0.24, 0.06, jnp.pi / 8])
    x, y, yaw = jax.random.uniform(key, (3,), minval=low, maxval=high)
    return task.Placement(
        mocap={"box": task.upright_pose(x, y, TABLE_HEIGHT, yaw)},
        joints={"box_lid": jnp.float32(OPEN_ANGLE)},
    )


def _on_lid(view: task.StateView, angle: Array | float, radius: float) -> Array:
    """A world point on the middle line of the lid, open by ``angle``, at ``radius`` from the hinge."""
    angle = jnp.asarray(angle)
    point = jnp.stack([0.0 * angle, -radius * jnp.cos(angle), HEIGHT + radius * jnp.sin(angle)])
    return task.point_in_world(view.body_pose("box"), point)


def _keypoints(view: task.StateView) -> Array:
    """The middle of the lid's edge."""
    return _on_lid(view, view.joint("box_lid"), LENGTH)[None, None]


def _success(view: task.StateView) -> Array:
    return view.joint("box_lid") < OPEN_ANGLE - CLOSED_BY


def _expert(view: task.StateView) -> Action:
    beyond = GRASP + CLEARANCE
    angles = jnp.array([ANGLES[0], *ANGLES, ANGLES[-1]])
    radii = [beyond, *[GRASP] * len(ANGLES), beyond]
    positions = [_on_lid(view, angle, radius) for angle, radius in zip(angles, radii, strict=True)]
    # The hand comes along the lid and turns with it.
    tilts = rotations.quaternion_from_axis_angle(jnp.array([1.0, 0.0, 0.0]), jnp.pi / 2 - angles)
    turns = rotations.quaternion_multiply(
        view.body_pose("box")[3:], rotations.quaternion_multiply(tilts, rotations.DOWN)
    )
    return task.keyframes(positions, [task.OPEN, *[task.CLOSED] * 3, task.OPEN, task.OPEN], turns)


TASK = task.Task(
    name="close_box",
    num_arms=1,
    build=_build,
    sample=_sample,
    instructions=(
        "close box",
        "close the box",
        "shut the lid of the box",
        "take the lid of the box and close it",
        "fold the lid over so that the box is shut",
    ),
    recognised_by=r"\bbox\b",
    objects=(task.TaskObject("box with two parts", "box_.*"),),
    keypoints=_keypoints,
    success=_success,
    expert=_expert,
)
