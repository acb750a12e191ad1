"""Take the pepper of the named colour off the kitchen scales. RLBench: take_off_weighing_scales."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from dsvla_jax.sim.robot import FIXTURE, OBJECT_AND_FIXTURE
from dsvla_jax.sim.tasks import task
from dsvla_jax.types import TABLE_HEIGHT, Action, Array

COLOURS = {"green": [0.15, 0.6, 0.1, 1], "red": [0.85, 0.08, 0.06, 1], "yellow": [0.98, 0.8, 0.08, 1]}
PEPPERS = tuple(f"pepper_{colour}" for colour in COLOURS)
PEPPER = 0.027  # radius of a pepper's collision sphere, metres
# In the frame of the root: the scales, with the dial along +x, and the middle of the free table beside them.
SCALES, BESIDE = (0.0, -0.13), (0.0, 0.15)
TRAY = 0.15  # height of the top of the tray
# Places on the tray, in the frame of the scales; a hand turned with the scales takes one and touches no other.
PLACES = np.array([[-0.045, 0.06], [-0.045, -0.06], [0.055, 0.0]], np.float32)
NEAR = 0.1  # half an edge of the square around BESIDE where the pepper is to be put
# Heights of the tool centre point over the pepper, while carrying it, and over the table when it lets go, metres.
APPROACH, CARRY, PLACE = 0.1, TRAY + 0.12, PEPPER + 0.006


def _build(spec: mujoco.MjSpec) -> None:
    scales = task.add_furniture(spec, "scales")
    body, steel, black = [0.2, 0.42, 0.5, 1], [0.78, 0.8, 0.82, 1], [0.1, 0.1, 0.1, 1]
    task.add_part(scales, "scales_foot", task.BOX, [0.075, 0.075, 0.01], [0, 0, 0.01], black)
    task.add_part(scales, "scales_body", task.BOX, [0.06, 0.065, 0.05], [0, 0, 0.07], body)
    task.add_part(scales, "scales_pole", task.CYLINDER, [0.02, 0.012], [0, 0, TRAY - 0.02], steel)
    task.add_part(scales, "scales_tray", task.BOX, [0.1, 0.1, 0.005], [0, 0, TRAY - 0.005], steel, FIXTURE)
    towards_x = [0.7071068, 0, 0.7071068, 0]
    dial = [0.045, 0.004], [0.061, 0, 0.07]
    task.add_part(scales, "scales_dial", task.CYLINDER, *dial, [0.95, 0.95, 0.93, 1], quat=towards_x)
    needle = {"fromto": [0.066, 0, 0.07, 0.066, 0.022, 0.095]}
    task.add_part(scales, "scales_needle", task.CAPSULE, [0.003], [0, 0, 0], [0.8, 0.1, 0.1, 1], **needle)

    for name, colour in zip(PEPPERS, COLOURS.values(), strict=True):
        # The damping stops it from rolling away.
        pepper = task.add_object(spec, name, TRAY + PEPPER, damping=1e-3)
        hidden = {"group": task.INVISIBLE_GROUP, "mass": 0.05}
        task.add_part(pepper, name, task.SPHERE, [PEPPER], [0, 0, 0], colour, OBJECT_AND_FIXTURE, **hidden)
        for i, (x, y) in enumerate(((1, 0), (0, 1), (-1, 0), (0, -1))):
            lobe = [0.011 * x, 0.011 * y, 0]
            task.add_part(pepper, f"{name}_lobe{i}", task.CAPSULE, [0.0165, 0.01], lobe, colour)
        task.add_part(pepper, f"{name}_stem", task.CAPSULE, [0.0045, 0.008], [0, 0, 0.026], [0.1, 0.35, 0.08, 1])


def _sample(key: Array, variation: Array) -> task.Placement:
    place_key, order_key = jax.random.split(key)
    low, high = jnp.array([0.1, -0.04, -jnp.pi / 4]), jnp.array([0.18, 0.04, jnp.pi / 4])
    x, y, yaw = jax.random.uniform(place_key, (3,), minval=low, maxval=high)
    root = task.upright_pose(x, y, TABLE_HEIGHT, yaw)
    scales = root.at[:3].set(task.point_in_world(root, (*SCALES, 0.0)))
    places = jax.random.permutation(order_key, jnp.asarray(PLACES))
    free = {}
    for name, place in zip(PEPPERS, places, strict=True):
        free[name] = scales.at[:3].set(task.point_in_world(scales, jnp.append(place, TRAY + PEPPER)))
    return task.Placement(mocap={"scales": scales}, free=free)


def _pepper(view: task.StateView) -> Array:
    """The position of the pepper of the variation's colour."""
    return jnp.stack([view.body_pose(name)[:3] for name in PEPPERS])[view.variation]


def _beside(view: task.StateView, height: float) -> Array:
    offset = np.subtract(BESIDE, SCALES)
    return task.point_in_world(view.body_pose("scales"), (*offset, height))


def _keypoints(view: task.StateView) -> Array:
    """The pepper, then where to put it on the table."""
    return jnp.stack([_pepper(view), _beside(view, PEPPER)])[None]


def _success(view: task.StateView) -> Array:
    x, y, z = task.point_in_body(view.body_pose("scales"), _pepper(view))
    off_x, off_y = np.subtract(BESIDE, SCALES)
    beside = (jnp.abs(x - off_x) < NEAR) & (jnp.abs(y - off_y) < NEAR)
    return beside & (z < 2 * PEPPER) & view.holds_nothing()


def _expert(view: task.StateView) -> Action:
    pepper = _pepper(view)
    over, lifted = pepper.at[2].add(APPROACH), pepper.at[2].set(TABLE_HEIGHT + CARRY)
    positions = [over, pepper, lifted, _beside(view, CARRY), _beside(view, PLACE)]
    grippers = [task.OPEN, task.CLOSED, task.CLOSED, task.CLOSED, task.OPEN]
    return task.keyframes(positions, grippers, task.pointing_down(task.yaw_of(view.body_pose("scales"))))


TASK = task.Task(
    name="take_off_weighing_scales",
    num_arms=1,
    build=_build,
    sample=_sample,
    instructions=(
        "remove the {colour} pepper from the weighing scales and place it on the table",
        "take the {colour} pepper off the scales",
        "pick the {colour} pepper up from the scales and put it on the table",
        "take the {colour} object off the tray and set it down on the table",
    ),
    recognised_by=r"\bpepper\b|\bscales\b|off the tray",
    objects=(task.TaskObject("{colour} pepper", "pepper_{colour}_.*"),),
    keypoints=_keypoints,
    success=_success,
    expert=_expert,
    variations=len(COLOURS),
    words=lambda variation: {"colour": list(COLOURS)[variation]},
    graspables=tuple(task.Graspable(name, (PEPPER, PEPPER, PEPPER)) for name in PEPPERS),
    targets=lambda view: jnp.arange(len(PEPPERS)) == view.variation,
    rests_on=dict.fromkeys(PEPPERS, "scales"),
    resizable=PEPPERS,
    colours_matter=True,
)
