"""Push a laptop over the edge of its holder with one arm, grasp it there with the other one and lift it.

RLBench (two arms): bimanual_pick_laptop. The keyboard lies flat on the holder, so that no finger gets under it before
it overhangs.
"""

import math

import jax
import jax.numpy as jnp
import mujoco

from dsvla_jax.sim.robot import OBJECT_AND_FIXTURE, CollisionBits
from dsvla_jax.sim.tasks import task
from dsvla_jax.types import TABLE_HEIGHT, Action, Array

# In the frame of the root, whose -y axis is the side at which one sits: half extents, metres.
HOLDER = (0.11, 0.08, 0.05)
BASE = (0.13, 0.09, 0.01)
LID, LID_TILT = 0.09, 0.25  # half the lid's height; how far it leans back, radians
BASE_HEIGHT = 2 * HOLDER[2] + BASE[2]
LID_MIDDLE = (0.0, BASE[1] + 0.018, BASE[2] + 0.086)  # in the laptop's frame
LIFTED = 1.0  # height of the lid's middle, metres
# The expert. The right arm grasps the front edge and the left one pushes the rear edge, both nearly level; the push
# ends so far from the rear edge that the front edge overhangs.
LEAN, PAD = 1.1, 0.008
BESIDE, PUSH, HELD, LIFT = 0.07, 0.05, 0.015, 0.2

HOLDER_BITS = CollisionBits(8, 0)  # holds the laptop up; the fingers that meet it too would cost time at every step


def _build(spec: mujoco.MjSpec) -> None:
    holder = task.add_furniture(spec, "laptop_holder")
    wood = [0.55, 0.38, 0.22, 1]
    x, y, z = HOLDER
    slab = task.add_part(holder, "laptop_holder", task.BOX, HOLDER, [0, 0, z], wood, HOLDER_BITS)
    slab.friction[0] = 0.4

    laptop = task.add_object(spec, "laptop", BASE_HEIGHT)
    silver, dark, screen = [0.78, 0.8, 0.83, 1], [0.15, 0.15, 0.17, 1], [0.25, 0.55, 0.9, 1]
    x, y, z = BASE
    base = task.add_part(laptop, "laptop", task.BOX, BASE, [0, 0, 0], silver, OBJECT_AND_FIXTURE, mass=0.4)
    base.friction[0] = 0.4
    task.add_part(laptop, "laptop_keys", task.BOX, [x - 0.02, 0.035, 0.001], [0, 0.035, z], dark)
    task.add_part(laptop, "laptop_pad", task.BOX, [0.035, 0.022, 0.001], [0, -0.05, z], [0.6, 0.62, 0.65, 1])
    across = {"quat": [0.70710678, 0, 0.70710678, 0]}
    task.add_part(laptop, "laptop_hinge", task.CAPSULE, [0.007, x - 0.02], [0, y - 0.005, z], dark, **across)
    lean = {"quat": [math.cos(LID_TILT / 2), -math.sin(LID_TILT / 2), 0, 0]}
    task.add_part(laptop, "laptop_lid", task.BOX, [x - 0.002, 0.005, LID], LID_MIDDLE, silver, mass=0.2, **lean)
    front = (0.0, LID_MIDDLE[1] - 0.0055, LID_MIDDLE[2] + 0.0014)
    task.add_part(laptop, "laptop_screen", task.BOX, [x - 0.012, 0.001, LID - 0.012], front, screen, **lean)


def _sample(key: Array, variation: Array) -> task.Placement:
    # The arms keep to their sides: turned by more, RLBench's laptop would have to change them.
    low, high = jnp.array([0.1, -0.05, -jnp.pi / 8]), jnp.array([0.22, 0.05, jnp.pi / 8])
    x, y, yaw = jax.random.uniform(key, (3,), minval=low, maxval=high)
    return task.Placement(
        mocap={"laptop_holder": task.upright_pose(x, y, TABLE_HEIGHT, yaw)},
        free={"laptop": task.upright_pose(x, y, TABLE_HEIGHT + BASE_HEIGHT, yaw)},
    )


def _keypoints(view: task.StateView) -> Array:
    """The rear edge of the laptop's base for the left arm, the front edge for the right one."""
    laptop = view.body_pose("laptop")
    return jnp.stack([task.point_in_world(laptop, (0.0, sign * BASE[1], 0.0)) for sign in (1, -1)])[:, None]


def _success(view: task.StateView) -> Array:
    return task.point_in_world(view.body_pose("laptop"), LID_MIDDLE)[2] >= LIFTED


def _expert(view: task.StateView) -> Action:
    laptop = view.body_pose("laptop")
    yaw = task.yaw_of(laptop)

    def at(y: float, z: float = 0.0) -> Array:
        return task.point_in_world(laptop, (0.0, y, z))

    rear, front = BASE[1] + PAD, -BASE[1] - PUSH
    left = [at(rear + BESIDE, 0.03), at(rear - PUSH), at(rear - PUSH), at(rear + BESIDE, 0.03)]
    waiting = at(front - BESIDE)
    right = [waiting, waiting, at(front + HELD), at(front + HELD, LIFT)]
    return task.both_arms(
        task.keyframes(left, [task.CLOSED] * 4, task.leaning(-LEAN, yaw)),
        task.keyframes(right, [task.OPEN, task.OPEN, task.CLOSED, task.CLOSED], task.leaning(LEAN, yaw)),
    )


TASK = task.Task(
    name="bimanual_pick_laptop",
    num_arms=2,
    build=_build,
    sample=_sample,
    instructions=(
        "pick up the laptop",
        "take the notebook off the holder",
        "push the laptop over the edge and lift it",
        "lift the laptop off its holder with both arms",
        "slide the laptop with one arm and lift it with the other",
    ),
    recognised_by=r"\b(pick up|pick|push|lift|slide) (the )?laptop\b|\bnotebook\b",
    objects=(task.TaskObject("laptop", "laptop(?!_holder).*"),),
    keypoints=_keypoints,
    success=_success,
    expert=_expert,
    graspables=(task.Graspable("laptop", BASE),),
    rests_on={"laptop": "laptop_holder"},
)
