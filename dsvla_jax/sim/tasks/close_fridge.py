"""Push the open upper door of a small fridge shut. RLBench: close_fridge.

The fridge stands on the robot's left with its front to the right, and its hinge on the robot's side: the open door
stands between the robot, which pushes its outer face, and the front camera, which sees its inner face.
"""

import jax
import jax.numpy as jnp
import mujoco

from dsvla_jax.sim.robot import FIXTURE
from dsvla_jax.sim.tasks import task
from dsvla_jax.types import TABLE_HEIGHT, Action, Array

# The root's frame lies under the hinge: +x along the closed door, -y out of the fridge's front.
WIDTH, DEPTH, HEIGHT, SPLIT = 0.22, 0.18, 0.36, 0.18  # the upper door reaches from SPLIT to HEIGHT
THICKNESS = 0.012  # half of a door's
START_ANGLE, CLOSED_BY = 1.25, 0.5236  # radians: how far the door stands open, and how much less is success
HANDLE = 0.19  # distance from the hinge, metres
# The expert: the heights of its tool centre point, the distance from the hinge at which it pushes, how far from the
# door it begins, the angle at which its straight push ends and the half width of the gripper.
PUSH_HEIGHT, PUSH_RADIUS, CLEARANCE, END_ANGLE, PAD = 0.31, 0.16, 0.09, 0.25, 0.01


def _build(spec: mujoco.MjSpec) -> None:
    root = task.add_furniture(spec, "fridge")
    silver, inside, dark = [0.75, 0.77, 0.8, 1], [0.93, 0.95, 0.97, 1], [0.2, 0.2, 0.22, 1]
    x, y, wall, middle = WIDTH / 2, DEPTH / 2 + THICKNESS, 0.006, (HEIGHT + SPLIT) / 2
    upper = (HEIGHT - SPLIT) / 2
    # The parts abut: where two surfaces coincide, which of them is seen is an accident.
    side_size, side_middle = upper - wall, middle - wall
    task.add_part(root, "fridge_lower", task.BOX, [x, DEPTH / 2, SPLIT / 2], [x, y, SPLIT / 2], silver, FIXTURE)
    task.add_part(root, "fridge_top", task.BOX, [x, DEPTH / 2, wall], [x, y, HEIGHT - wall], silver, FIXTURE)
    for i, side in enumerate((wall, WIDTH - wall)):
        task.add_part(root, f"fridge_side{i}", task.BOX, [wall, DEPTH / 2, side_size], [side, y, side_middle], silver)
    back = [x - 2 * wall, wall, side_size]
    task.add_part(root, "fridge_back", task.BOX, back, [x, THICKNESS + DEPTH - wall, side_middle], inside)
    task.add_part(root, "fridge_shelf", task.BOX, [x - 2 * wall, DEPTH / 2 - 0.015, 0.003], [x, y, middle], inside)
    task.add_part(root, "fridge_bottle", task.CYLINDER, [0.02, 0.035], [x, y, SPLIT + 0.035], [0.2, 0.6, 0.25, 1])
    task.add_part(root, "fridge_lower_door", task.BOX, [x, THICKNESS, SPLIT / 2 - 0.004], [x, 0, SPLIT / 2], silver)
    task.add_part(root, "fridge_lower_handle", task.CAPSULE, [0.008, 0.04], [HANDLE, -0.025, SPLIT - 0.07], dark)

    door = root.add_body(name="fridge_door", pos=[0, 0, middle])
    joint = door.add_joint(name="fridge_door", type=task.HINGE, axis=[0, 0, -1], range=[0.0, 1.4], limited=True)
    joint.frictionloss, joint.damping[0], joint.armature = 0.2, 0.3, 0.01
    size = [x, THICKNESS, upper - 0.002]
    task.add_part(door, "fridge_door", task.BOX, size, [x, 0, 0], silver, FIXTURE, mass=0.5)
    task.add_part(door, "fridge_door_lining", task.BOX, [x - 0.015, 0.004, upper - 0.02], [x, 0.01, 0], inside)
    task.add_part(door, "fridge_door_rack", task.BOX, [x - 0.03, 0.015, 0.012], [x, 0.025, -0.04], [0.4, 0.6, 0.8, 1])
    task.add_part(door, "fridge_door_handle", task.CAPSULE, [0.008, 0.04], [HANDLE, -0.025, -0.02], dark)


def _sample(key: Array, variation: Array) -> task.Placement:
    low, high = jnp.array([0.14, 0.02, -jnp.pi / 4]), jnp.array([0.22, 0.12, jnp.pi / 4])
    x, y, yaw = jax.random.uniform(key, (3,), minval=low, maxval=high)
    return task.Placement(
        mocap={"fridge": task.upright_pose(x, y, TABLE_HEIGHT, yaw)},
        joints={"fridge_door": jnp.float32(START_ANGLE)},
    )


def _on_door(view: task.StateView, angle: Array | float, radius: float, outwards: float, height: float) -> Array:
    """A world point at ``radius`` from the hinge of a door open by ``angle``, ``outwards`` in front of its middle."""
    along = jnp.stack([jnp.cos(angle), -jnp.sin(angle)])
    normal = jnp.stack([-jnp.sin(angle), -jnp.cos(angle)])
    return task.point_in_world(view.body_pose("fridge"), jnp.append(radius * along + outwards * normal, height))


def _keypoints(view: task.StateView) -> Array:
    """The handle of the upper door, at the outer edge of the door."""
    return _on_door(view, view.joint("fridge_door"), HANDLE, THICKNESS, PUSH_HEIGHT)[None, None]


def _success(view: task.StateView) -> Array:
    return view.joint("fridge_door") < START_ANGLE - CLOSED_BY


def _expert(view: task.StateView) -> Action:
    beside = _on_door(view, view.joint("fridge_door"), PUSH_RADIUS, THICKNESS + CLEARANCE, PUSH_HEIGHT)
    pushed = _on_door(view, END_ANGLE, PUSH_RADIUS, THICKNESS + PAD, PUSH_HEIGHT)
    return task.keyframes([beside, pushed], [task.OPEN, task.OPEN])


TASK = task.Task(
    name="close_fridge",
    num_arms=1,
    build=_build,
    sample=_sample,
    instructions=(
        "close fridge",
        "close the fridge",
        "shut the fridge door",
        "push the fridge door shut",
        "close the top door of the fridge",
    ),
    recognised_by=r"\bfridge\b",
    objects=(task.TaskObject("fridge", "fridge_.*"),),
    keypoints=_keypoints,
    success=_success,
    expert=_expert,
)
