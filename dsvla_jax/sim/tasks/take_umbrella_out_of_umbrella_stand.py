"""Pull an umbrella up out of its stand. RLBench: take_umbrella_out_of_umbrella_stand."""

import jax
import jax.numpy as jnp
import mujoco

from dsvla_jax.sim.robot import OBJECT, OBJECT_AND_FIXTURE, SURFACE
from dsvla_jax.sim.tasks import task
from dsvla_jax.types import TABLE_HEIGHT, Action, Array

INSIDE, WALL, HEIGHT = 0.035, 0.004, 0.15  # the stand's inner half width, half thickness of a wall, height, metres
# The umbrella's frame: the origin is its lower end, z along it, and its hook points along x.
IN_STAND = (0.0, 0.0, 0.002)
FOLDED_RADIUS, FOLDED = 0.02, 0.18  # of the folded cloth, and its length
HANDLE, HANDLE_LENGTH, HANDLE_RADIUS = (0.0, 0.0, 0.235), 0.041, 0.011  # middle, half of its length
GRASP = 0.25  # height of the tool centre point along the umbrella: what is above still fits under the palm
APPROACH, LIFT = 0.08, 0.225  # metres over the grasp


def _build(spec: mujoco.MjSpec) -> None:
    stand = task.add_furniture(spec, "umbrella_stand")
    grey, blue, tan = [0.35, 0.36, 0.4, 1], [0.12, 0.25, 0.8, 1], [0.85, 0.62, 0.3, 1]
    middle, outer = INSIDE + WALL, INSIDE + 2 * WALL
    for i, (x, y) in enumerate(((middle, 0), (-middle, 0), (0, middle), (0, -middle))):
        size = [WALL, outer, HEIGHT / 2] if x else [INSIDE, WALL, HEIGHT / 2]
        task.add_part(stand, f"umbrella_stand_wall{i}", task.BOX, size, [x, y, HEIGHT / 2], grey, SURFACE)

    umbrella = task.add_object(spec, "umbrella", IN_STAND[2], damping=1e-3)
    size, place = [FOLDED_RADIUS, FOLDED / 2 - FOLDED_RADIUS], [0, 0, FOLDED / 2]
    task.add_part(umbrella, "umbrella_cloth", task.CAPSULE, size, place, blue, OBJECT_AND_FIXTURE, mass=0.12)
    size = [HANDLE_RADIUS, HANDLE_LENGTH - HANDLE_RADIUS]
    task.add_part(umbrella, "umbrella_handle", task.CAPSULE, size, HANDLE, tan, OBJECT, mass=0.03)
    task.add_part(umbrella, "umbrella_shaft", task.CAPSULE, [0.006, 0.02], [0, 0, FOLDED], [0.8, 0.8, 0.82, 1])
    # The hook lies between the fingers, which close across it.
    top, reach = HANDLE[2] + HANDLE_LENGTH - HANDLE_RADIUS, 0.04
    along_x = [0.7071068, 0, 0.7071068, 0]
    task.add_part(umbrella, "umbrella_hook", task.CAPSULE, [0.01, reach / 2], [reach / 2, 0, top], tan, quat=along_x)
    task.add_part(umbrella, "umbrella_hook_end", task.CAPSULE, [0.0095, 0.012], [reach, 0, top - 0.012], tan)


def _sample(key: Array, variation: Array) -> task.Placement:
    low, high = jnp.array([0.05, -0.22, -jnp.pi]), jnp.array([0.25, 0.22, jnp.pi])
    x, y, yaw = jax.random.uniform(key, (3,), minval=low, maxval=high)
    stand = task.upright_pose(x, y, TABLE_HEIGHT, yaw)
    umbrella = jnp.concatenate([task.point_in_world(stand, IN_STAND), stand[3:]])
    return task.Placement(mocap={"umbrella_stand": stand}, free={"umbrella": umbrella})


def _keypoints(view: task.StateView) -> Array:
    """The handle of the umbrella."""
    return task.point_in_world(view.body_pose("umbrella"), (0.0, 0.0, GRASP))[None, None]


def _success(view: task.StateView) -> Array:
    """The lower end of the umbrella is out of the stand."""
    x, y, z = task.point_in_body(view.body_pose("umbrella_stand"), view.body_pose("umbrella")[:3])
    return (jnp.abs(x) > INSIDE) | (jnp.abs(y) > INSIDE) | (z > HEIGHT)


def _expert(view: task.StateView) -> Action:
    umbrella = view.body_pose("umbrella")
    positions = [
        task.point_in_world(umbrella, (0.0, 0.0, height)) for height in (GRASP + APPROACH, GRASP, GRASP + LIFT)
    ]
    return task.keyframes(positions, [task.OPEN, task.CLOSED, task.CLOSED], task.pointing_down(task.yaw_of(umbrella)))


TASK = task.Task(
    name="take_umbrella_out_of_umbrella_stand",
    num_arms=1,
    build=_build,
    sample=_sample,
    instructions=(
        "take umbrella out of umbrella stand",
        "pull the umbrella out of its stand",
        "grasp the umbrella by its handle and lift it out of the stand",
        "lift the umbrella up and out of the umbrella stand",
        "remove the umbrella from the stand",
    ),
    recognised_by=r"\bumbrella\b",
    objects=(task.TaskObject("umbrella handle", "umbrella_(handle|hook.*)"),),
    keypoints=_keypoints,
    success=_success,
    expert=_expert,
    graspables=(task.Graspable("umbrella", (HANDLE_RADIUS, HANDLE_RADIUS, HANDLE_LENGTH), HANDLE),),
    attachments=(task.Attachment("umbrella", "umbrella_stand", IN_STAND),),
    release=lambda view: view.holds("umbrella"),
)
