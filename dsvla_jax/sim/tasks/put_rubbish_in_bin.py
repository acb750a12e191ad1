"""Pick up a piece of crumpled paper, not a tomato, and drop it into the bin. RLBench: put_rubbish_in_bin."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from dsvla_jax.sim.robot import FIXTURE, OBJECT_AND_FIXTURE
from dsvla_jax.sim.tasks import task
from dsvla_jax.types import TABLE_HEIGHT, Action, Array

RUBBISH = 0.02  # half an edge of the paper's collision box, metres
TOMATO = 0.024  # radius
# In the frame of the root: the bin, and the three places that the rubbish and the tomatoes are shuffled over.
BIN = (-0.15, 0.0)
PLACES = np.array([[0.01, 0.0], [0.11, 0.05], [0.11, -0.05]], np.float32)
INSIDE, WALL, HEIGHT = 0.065, 0.004, 0.12  # the bin's inner half width, half thickness of a wall, height
# Heights over the table of the tool centre point: over the rubbish, grasping it, and while carrying it.
APPROACH, GRASP, CARRY = 0.12, 0.022, 0.22
OBJECTS = ("rubbish", "rubbish_tomato_left", "rubbish_tomato_right")


def _build(spec: mujoco.MjSpec) -> None:
    bin_body = task.add_furniture(spec, "rubbish_bin")
    black = [0.12, 0.12, 0.13, 1]
    middle, outer = INSIDE + WALL, INSIDE + 2 * WALL
    for i, (x, y) in enumerate(((middle, 0), (-middle, 0), (0, middle), (0, -middle))):
        size = [WALL, outer, HEIGHT / 2] if x else [INSIDE, WALL, HEIGHT / 2]
        task.add_part(bin_body, f"rubbish_bin_wall{i}", task.BOX, size, [x, y, HEIGHT / 2], black, FIXTURE)
    # What falls in lies on the table's plane: the bottom is only looked at.
    task.add_part(bin_body, "rubbish_bin_bottom", task.BOX, [INSIDE, INSIDE, 0.001], [0, 0, 0.001], black)

    rubbish = task.add_object(spec, "rubbish", RUBBISH, damping=1e-4)
    white = [0.95, 0.95, 0.95, 1]
    # Of 0.05 kg, it shoots out of closing fingers in 1 of 125 episodes of C MuJoCo; of 0.2 kg, in none of 1,000.
    task.add_part(rubbish, "rubbish", task.BOX, [RUBBISH] * 3, [0, 0, 0], white, OBJECT_AND_FIXTURE, mass=0.2)
    for i, (quat, shade) in enumerate((([0.9, 0.3, 0.3, 0.1], 0.9), ([0.9, -0.2, 0.1, 0.4], 0.85))):
        creased = [shade, shade, shade, 1]
        task.add_part(rubbish, f"rubbish_crease{i}", task.BOX, [0.0175] * 3, [0, 0, 0.001], creased, quat=quat)

    red = [0.8, 0.12, 0.08, 1]
    for name in OBJECTS[1:]:
        # The damping stops a tomato from rolling away.
        tomato = task.add_object(spec, name, TOMATO, damping=1e-3)
        task.add_part(tomato, name, task.SPHERE, [TOMATO], [0, 0, 0], red, OBJECT_AND_FIXTURE, mass=0.05)
        task.add_part(tomato, f"{name}_stem", task.CAPSULE, [0.005, 0.004], [0, 0, TOMATO], [0.15, 0.5, 0.1, 1])


def _sample(key: Array, variation: Array) -> task.Placement:
    place_key, order_key, turn_key = jax.random.split(key, 3)
    # Turned further, the bin would stand between the front camera and the rubbish.
    low, high = jnp.array([0.12, -0.1, -2.0]), jnp.array([0.2, 0.1, 2.0])
    x, y, yaw = jax.random.uniform(place_key, (3,), minval=low, maxval=high)
    root = task.upright_pose(x, y, TABLE_HEIGHT, yaw)
    places = jax.random.permutation(order_key, jnp.asarray(PLACES))
    # Nearly along the fingers: a box pinched at its corners jumps out of a hard grip.
    turn = jax.random.uniform(turn_key, (), minval=-0.2, maxval=0.2)
    free = {}
    for place, name, height, angle in zip(places, OBJECTS, (RUBBISH, TOMATO, TOMATO), (turn, 0.0, 0.0), strict=True):
        x, y, _ = task.point_in_world(root, jnp.append(place, 0.0))
        free[name] = task.upright_pose(x, y, TABLE_HEIGHT + height, angle)
    x, y, z = task.point_in_world(root, (*BIN, 0.0))
    return task.Placement(mocap={"rubbish_bin": task.upright_pose(x, y, z, yaw)}, free=free)


def _keypoints(view: task.StateView) -> Array:
    """The rubbish, then the middle of the bin's opening."""
    opening = task.point_in_world(view.body_pose("rubbish_bin"), (0.0, 0.0, HEIGHT))
    return jnp.stack([view.body_pose("rubbish")[:3], opening])[None]


def _success(view: task.StateView) -> Array:
    """The middle of the rubbish is in the lower half of the bin: it has been dropped, not only carried over the bin."""
    x, y, z = task.point_in_body(view.body_pose("rubbish_bin"), view.body_pose("rubbish")[:3])
    return (jnp.abs(x) < INSIDE) & (jnp.abs(y) < INSIDE) & (z > 0.0) & (z < HEIGHT / 2)


def _expert(view: task.StateView) -> Action:
    rubbish, bin_pose = view.body_pose("rubbish"), view.body_pose("rubbish_bin")

    def over(pose: Array, height: float) -> Array:
        return pose[:3].at[2].set(TABLE_HEIGHT + height)

    positions = [over(rubbish, APPROACH), over(rubbish, GRASP), over(rubbish, CARRY), over(bin_pose, CARRY)]
    return task.keyframes(positions, [task.OPEN, task.CLOSED, task.CLOSED, task.OPEN])


TASK = task.Task(
    name="put_rubbish_in_bin",
    num_arms=1,
    build=_build,
    sample=_sample,
    instructions=(
        "put rubbish in bin",
        "drop the rubbish into the bin",
        "pick up the rubbish and leave it in the trash can",
        "throw away the trash, leaving any other objects alone",
        "pick up the white paper and put it in the black bin",
    ),
    recognised_by=r"\b(rubbish|trash|white paper)\b",
    objects=(
        task.TaskObject("small white rubbish", r"rubbish(_crease\d)?"),
        task.TaskObject("black bin", "rubbish_bin.*"),
    ),
    keypoints=_keypoints,
    success=_success,
    expert=_expert,
    graspables=(
        task.Graspable("rubbish", (RUBBISH, RUBBISH, RUBBISH)),
        *(task.Graspable(name, (TOMATO, TOMATO, TOMATO)) for name in OBJECTS[1:]),
    ),
    resizable=OBJECTS,
    colours_matter=True,
    targets=lambda view: jnp.array([True, False, False]),
)
