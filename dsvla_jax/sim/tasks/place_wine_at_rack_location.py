"""Take a wine bottle by its neck and lay it into the named slot of a rack. RLBench: place_wine_at_rack_location.

The rack's slots lie side by side and slope down away from the front camera, towards the robot, which reaches over them.
"""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from dsvla_jax.geometry import rotations
from dsvla_jax.sim.robot import FIXTURE, OBJECT, OBJECT_AND_FIXTURE, SINGLE_BASE
from dsvla_jax.sim.tasks import task
from dsvla_jax.types import TABLE_HEIGHT, Action, Array

SLOTS = {"middle": 0.0, "left": 0.09, "right": -0.09}  # y of a slot's middle, seen by the robot, metres
SLOPE = np.deg2rad(20.0)
# The bottle, metres: its origin is in the middle of its height. The collision box of its body is a little slimmer.
HALF, BODY, NECK = 0.12, 0.034, 0.014  # half its height, radius of the body and of the neck
BODY_TOP, GRASP = 0.03, 0.07  # heights over the origin of the body's end and of the grasp on the neck
LYING = 0.105  # height of the origin of the bottle in a slot
RAIL = 0.01  # radius of the rails on which it lies; they are at RAILS along the bottle
RAILS = (-0.09, 0.02)
TALL = 0.17  # height of the rack
# Success: how far the bottle's origin may be from where it lies in the slot.
NEAR = (0.05, 0.025, 0.04)
# The expert: angle between the hand's axis and straight down at the grasp; how far it backs off, lifts and inserts.
TILT, BACK, LIFT, INSERT, ABOVE = np.deg2rad(45.0), 0.09, 0.1, 0.13, 0.004


def _turn_y(angle: float) -> Array:
    return rotations.quaternion_from_axis_angle(jnp.array([0.0, 1.0, 0.0]), jnp.float32(angle))


def _build(spec: mujoco.MjSpec) -> None:
    rack = task.add_furniture(spec, "wine_rack")
    wood, dark = [0.75, 0.52, 0.28, 1], [0.4, 0.24, 0.12, 1]
    width, gap = 1.5 * SLOTS["left"], SLOTS["left"] / 2
    for i, along in enumerate(RAILS):
        # The rail touches the underside of the sloping bottle.
        below = BODY + RAIL
        x = along * np.cos(SLOPE) + below * np.sin(SLOPE)
        z = LYING + along * np.sin(SLOPE) - below * np.cos(SLOPE)
        rail = {"fromto": [x, -width, z, x, width, z]}
        task.add_part(rack, f"wine_rack_rail{i}", task.CAPSULE, [RAIL], [0, 0, 0], dark, FIXTURE, **rail)
        task.add_part(rack, f"wine_rack_top{i}", task.BOX, [0.007, width + 0.007, 0.007], [x, 0, TALL], wood)
        for j, y in enumerate((-3 * gap, -gap, gap, 3 * gap)):
            post = [0.0065, 0.0065, TALL / 2 - 0.004]
            task.add_part(rack, f"wine_rack_post{i}{j}", task.BOX, post, [x, y, TALL / 2 - 0.004], wood)

    bottle = task.add_object(spec, "wine_bottle", HALF, damping=1e-3)
    glass, seal, white = [0.08, 0.25, 0.12, 1], [0.75, 0.1, 0.15, 1], [0.93, 0.9, 0.8, 1]
    length, middle = (HALF + BODY_TOP) / 2, (BODY_TOP - HALF) / 2
    hidden = {"group": task.INVISIBLE_GROUP, "mass": 0.2}
    box = [BODY, BODY, length]
    task.add_part(bottle, "wine_bottle", task.BOX, box, [0, 0, middle], glass, OBJECT_AND_FIXTURE, **hidden)
    neck = {"fromto": [0, 0, BODY_TOP, 0, 0, HALF - NECK], "mass": 0.02}
    task.add_part(bottle, "wine_bottle_neck", task.CAPSULE, [NECK], [0, 0, 0], glass, OBJECT, **neck)
    task.add_part(bottle, "wine_bottle_body", task.CYLINDER, [BODY, length], [0, 0, middle], glass)
    task.add_part(bottle, "wine_bottle_shoulder", task.SPHERE, [BODY], [0, 0, BODY_TOP - 0.001], glass)
    task.add_part(bottle, "wine_bottle_label", task.CYLINDER, [BODY + 0.001, 0.035], [0, 0, middle], white)
    task.add_part(bottle, "wine_bottle_cap", task.CYLINDER, [NECK + 0.002, 0.014], [0, 0, HALF - 0.012], seal)


def _sample(key: Array, variation: Array) -> task.Placement:
    # The bottle stands on the robot's left, far enough away for a hand that comes from the side. It is turned towards
    # the robot, which does not show, but lets its box lie flat on the rails.
    low = jnp.array([-0.02, -0.14, -jnp.pi / 6, 0.16, 0.16])
    high = jnp.array([0.05, -0.08, jnp.pi / 6, 0.24, 0.24])
    rack_x, rack_y, yaw, x, y = jax.random.uniform(key, (5,), minval=low, maxval=high)
    heading = jnp.arctan2(y - SINGLE_BASE[1], x - SINGLE_BASE[0])
    return task.Placement(
        mocap={"wine_rack": task.upright_pose(rack_x, rack_y, TABLE_HEIGHT, yaw)},
        free={"wine_bottle": task.upright_pose(x, y, TABLE_HEIGHT + HALF, heading)},
    )


def _slot(view: task.StateView) -> Array:
    """Where the origin of the bottle is in the variation's slot, in the frame of the rack."""
    y = jnp.asarray(list(SLOTS.values()), jnp.float32)[view.variation]
    return jnp.stack([jnp.float32(0.0), y, jnp.float32(LYING)])


def _in_slot(view: task.StateView, along: float, above: float = 0.0) -> Array:
    """A world point on the axis of a bottle in the variation's slot, ``along`` towards its neck and ``above`` it."""
    sine, cosine = np.sin(SLOPE), np.cos(SLOPE)
    offset = jnp.array([along * cosine - above * sine, 0.0, along * sine + above * cosine], jnp.float32)
    return task.point_in_world(view.body_pose("wine_rack"), _slot(view) + offset)


def _keypoints(view: task.StateView) -> Array:
    """The neck of the bottle, then the opening of the slot."""
    neck = task.point_in_world(view.body_pose("wine_bottle"), (0.0, 0.0, GRASP))
    return jnp.stack([neck, _in_slot(view, BODY_TOP)])[None]


def _success(view: task.StateView) -> Array:
    bottle = task.point_in_body(view.body_pose("wine_rack"), view.body_pose("wine_bottle")[:3])
    return jnp.all(jnp.abs(bottle - _slot(view)) < jnp.array(NEAR)) & view.holds_nothing()


def _expert(view: task.StateView) -> Action:
    bottle, rack = view.body_pose("wine_bottle"), view.body_pose("wine_rack")
    neck = task.point_in_world(bottle, (0.0, 0.0, GRASP))
    grasp = rotations.quaternion_multiply(bottle[3:], rotations.quaternion_multiply(_turn_y(-TILT), rotations.DOWN))
    approach = rotations.quaternion_rotate(grasp, jnp.array([0.0, 0.0, 1.0]))
    # The bottle tips over by this angle, from upright to the slope of the slot, with its neck along the rack's x axis.
    tipped = _turn_y(np.pi / 2 - SLOPE - TILT)
    lay = rotations.quaternion_multiply(rack[3:], rotations.quaternion_multiply(tipped, rotations.DOWN))
    up = jnp.array([0.0, 0.0, LIFT])
    positions = [neck - BACK * approach, neck, neck + up, _in_slot(view, GRASP + INSERT, ABOVE), _in_slot(view, GRASP)]
    grippers = [task.OPEN, task.CLOSED, task.CLOSED, task.CLOSED, task.OPEN]
    return task.keyframes(positions, grippers, jnp.stack([grasp] * 3 + [lay] * 2))


TASK = task.Task(
    name="place_wine_at_rack_location",
    num_arms=1,
    build=_build,
    sample=_sample,
    instructions=(
        "place the wine bottle to the {slot} side of the rack",
        "put the bottle away to the {slot} side of the rack",
        "lay the wine into the {slot} slot of the wine rack",
        "slide the bottle onto the {slot} part of the rack",
    ),
    recognised_by=r"\bwine\b|\bbottle\b",
    objects=(
        task.TaskObject("wine", "wine_bottle.*"),
        task.TaskObject("rack", "wine_rack.*"),
    ),
    keypoints=_keypoints,
    success=_success,
    expert=_expert,
    variations=len(SLOTS),
    words=lambda variation: {"slot": list(SLOTS)[variation]},
    graspables=(task.Graspable("wine_bottle", (NECK, NECK, 0.04), (0.0, 0.0, GRASP)),),
)
