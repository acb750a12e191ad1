"""Take the handle of a microwave's door and pull the door open. RLBench: open_microwave.

The front looks to the robot's right and to the camera; the hand comes from above and turns with the door.
"""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from dsvla_jax.geometry import rotations
from dsvla_jax.sim.robot import FIXTURE
from dsvla_jax.sim.tasks import task
from dsvla_jax.types import TABLE_HEIGHT, Action, Array

# The root's frame lies under the hinge: +x along the closed door, -y out of the front.
WIDTH, DEPTH, HEIGHT, DOOR = 0.29, 0.19, 0.19, 0.22  # metres; the rest of the width is the panel with the buttons
THICKNESS, WALL = 0.01, 0.006  # half of the door's, half of the case's
HANDLE, GRIP, PROUD = 0.2, 0.009, 0.03  # the handle's distance from the hinge, radius, and distance from the door
HANDLE_MIDDLE, HANDLE_HALF = 0.13, 0.045  # its height, and half its length without the rounded ends
OPENED = np.deg2rad(80.0)
# The expert: heights of the tool centre point over the handle and holding it, so high that the palm passes over the
# door; and the door's angles on the way.
ABOVE, GRASP = 0.28, 0.155
ANGLES = (0.0, 0.4, 0.8, 1.2, 1.56)


def _build(spec: mujoco.MjSpec) -> None:
    root = task.add_furniture(spec, "microwave")
    white, grey, dark, glass = [0.92, 0.92, 0.9, 1], [0.6, 0.6, 0.62, 1], [0.15, 0.15, 0.17, 1], [0.2, 0.25, 0.3, 1]
    # The back of the door touches the case at y = THICKNESS.
    x, y, z, middle = DOOR / 2, THICKNESS + DEPTH / 2, HEIGHT / 2, WIDTH / 2
    for i, height in enumerate((WALL, HEIGHT - WALL)):
        task.add_part(root, f"microwave_case{i}", task.BOX, [middle, DEPTH / 2, WALL], [middle, y, height], white)
    inner = z - 2 * WALL
    task.add_part(root, "microwave_side", task.BOX, [WALL, DEPTH / 2, inner], [WALL, y, z], white)
    back = [x - WALL, WALL, inner]
    task.add_part(root, "microwave_back", task.BOX, back, [x + WALL, THICKNESS + DEPTH - WALL, z], grey)
    plate = [x, y, 2 * WALL + 0.006]
    task.add_part(root, "microwave_plate", task.CYLINDER, [0.075, 0.004], plate, [0.75, 0.85, 0.9, 1])
    panel, panel_x = (WIDTH - DOOR) / 2, (WIDTH + DOOR) / 2
    task.add_part(root, "microwave_machine", task.BOX, [panel, DEPTH / 2, inner], [panel_x, y, z], white)
    task.add_part(root, "microwave_panel", task.BOX, [panel - 0.003, THICKNESS, z - 0.004], [panel_x, 0, z], grey)
    display = [panel_x, -THICKNESS, HEIGHT - 0.035]
    task.add_part(root, "microwave_display", task.BOX, [0.022, 0.002, 0.012], display, [0.1, 0.8, 0.4, 1])
    for i in range(2):
        dial = {"quat": [0.70710678, 0.70710678, 0, 0]}
        place = [panel_x, -THICKNESS - 0.005, 0.1 - 0.055 * i]
        task.add_part(root, f"microwave_dial{i}", task.CYLINDER, [0.017, 0.007], place, dark, **dial)
    # One solid collides for the whole case: nothing needs to reach into it.
    solid = [middle, DEPTH / 2, z]
    hidden = {"group": task.INVISIBLE_GROUP}
    task.add_part(root, "microwave_solid", task.BOX, solid, [middle, y, z], white, FIXTURE, **hidden)

    door = root.add_body(name="microwave_door", pos=[0, 0, 0])
    joint = door.add_joint(name="microwave_door", type=task.HINGE, axis=[0, 0, -1], range=[0.0, 1.9], limited=True)
    joint.frictionloss, joint.damping[0], joint.armature = 0.1, 0.1, 0.01
    size = [x - 0.002, THICKNESS, z - 0.004]
    task.add_part(door, "microwave_door", task.BOX, size, [x, 0, z], white, FIXTURE, mass=0.5)
    task.add_part(door, "microwave_window", task.BOX, [0.075, THICKNESS, 0.055], [0.09, -0.001, z], glass, mass=0)
    handle, grip = [HANDLE, -THICKNESS - PROUD, HANDLE_MIDDLE], [GRIP, HANDLE_HALF]
    task.add_part(door, "microwave_handle", task.CAPSULE, grip, handle, dark, FIXTURE, mass=0.05)
    for i, side in enumerate((0.01, 0.04)):
        foot = [HANDLE, -THICKNESS - PROUD / 2, HANDLE_MIDDLE - side]
        task.add_part(door, f"microwave_handle_foot{i}", task.BOX, [0.005, PROUD / 2, 0.005], foot, dark, mass=0)


def _sample(key: Array, variation: Array) -> task.Placement:
    low, high = jnp.array([0.06, -0.06, jnp.pi / 8]), jnp.array([0.14, 0.04, 3 * jnp.pi / 8])
    x, y, yaw = jax.random.uniform(key, (3,), minval=low, maxval=high)
    return task.Placement(mocap={"microwave": task.upright_pose(x, y, TABLE_HEIGHT, yaw)})


def _handle(view: task.StateView, angle: Array | float, height: float) -> Array:
    """A world point on the axis of the handle, ``height`` metres above the table, of a door open by ``angle``."""
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    out = THICKNESS + PROUD
    point = jnp.stack([HANDLE * cos - out * sin, -HANDLE * sin - out * cos, jnp.asarray(height)])
    return task.point_in_world(view.body_pose("microwave"), point)


def _keypoints(view: task.StateView) -> Array:
    """The upper end of the handle."""
    return _handle(view, view.joint("microwave_door"), GRASP)[None, None]


def _success(view: task.StateView) -> Array:
    return view.joint("microwave_door") > OPENED


def _expert(view: task.StateView) -> Action:
    angles = jnp.array([ANGLES[0], *ANGLES])
    heights = [ABOVE, *[GRASP] * len(ANGLES)]
    positions = [_handle(view, angle, height) for angle, height in zip(angles, heights, strict=True)]
    # The fingers open along the door; of the two such turns the arm can follow this one all the way.
    yaw = task.yaw_of(view.body_pose("microwave"))
    turns = rotations.quaternion_multiply(
        rotations.quaternion_from_axis_angle(jnp.array([0.0, 0.0, 1.0]), yaw - angles + jnp.pi / 2), rotations.DOWN
    )
    return task.keyframes(positions, [task.OPEN, *[task.CLOSED] * len(ANGLES)], turns)


TASK = task.Task(
    name="open_microwave",
    num_arms=1,
    build=_build,
    sample=_sample,
    instructions=(
        "open microwave",
        "open the microwave",
        "pull the microwave door open",
        "open the door of the microwave by its handle",
        "grasp the small handle and open the microwave",
    ),
    recognised_by=r"\bmicrowave\b",
    objects=(task.TaskObject("small handle on microwave", "microwave_handle.*"),),
    keypoints=_keypoints,
    success=_success,
    expert=_expert,
)
