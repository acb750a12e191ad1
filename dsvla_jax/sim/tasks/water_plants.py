"""Carry a watering can to a plant and tilt it until five drops have fallen into the pot. RLBench: water_plants."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from dsvla_jax.geometry import rotations
from dsvla_jax.sim.robot import OBJECT, SURFACE, CollisionBits
from dsvla_jax.sim.tasks import task
from dsvla_jax.types import TABLE_HEIGHT, Action, Array

DROP_BITS = CollisionBits(0, 9)  # drops are hit by the table and by the soil
DROP = 0.007  # radius, metres
DROPS = tuple(f"drop{i}" for i in range(5))
# The can, metres: its origin is under the middle of its body, its spout points along x. The handle is a bar along x.
BODY, BODY_TOP, HANDLE, HANDLE_TOP, BAR = 0.038, 0.09, 0.009, 0.145, 0.035
HEAD, ROSE = np.array([0.125, 0.0, 0.12], np.float32), 0.022  # the head of the spout, and its radius
# The drops ride inside the head, in a ring about its middle.
RING = 0.012 * np.stack([np.cos(np.arange(5) * 0.4 * np.pi), np.sin(np.arange(5) * 0.4 * np.pi), np.zeros(5)], axis=-1)
POT, SOIL = 0.055, 0.072  # radius of the pot, height of the soil
# In the frame of the root, along x: the can and the plant.
CAN, PLANT = -0.14, 0.14
# The water is let go when the head is over the pot, at a height in POUR, and the spout dips by at least DIP radians.
OVER, POUR, DIP = 0.04, (0.1, 0.28), np.deg2rad(25.0)
NEAR, LIFTED = 0.12, 0.04  # before that, the head has come so near to the pot's axis, with the can so high
# The expert: heights of its approach and lift, where it holds the head, and how far it tilts the can, in three steps.
APPROACH, LIFT, POUR_HEIGHT, TILTS = 0.1, 0.14, 0.21, np.deg2rad((35.0, 43.0, 50.0))


def _build(spec: mujoco.MjSpec) -> None:
    plant = task.add_furniture(spec, "plant")
    clay, earth, green = [0.75, 0.36, 0.2, 1], [0.2, 0.12, 0.07, 1], [0.15, 0.55, 0.15, 1]
    task.add_part(plant, "plant_pot", task.CYLINDER, [POT, 0.034], [0, 0, 0.034], clay)
    task.add_part(plant, "plant_rim", task.CYLINDER, [POT + 0.006, 0.008], [0, 0, 0.062], clay)
    task.add_part(plant, "plant_soil", task.CYLINDER, [POT - 0.007, 0.006], [0, 0, SOIL - 0.006], earth)
    # What drops land on: the pot and the soil are only looked at.
    ground = [POT, POT, SOIL / 2]
    hidden = {"group": task.INVISIBLE_GROUP}
    task.add_part(plant, "plant_ground", task.BOX, ground, [0, 0, SOIL / 2], earth, SURFACE, **hidden)
    for i, angle in enumerate(np.arange(6) * np.pi / 3):
        out = np.array([np.cos(angle), np.sin(angle), 0.0])
        root, tip = 0.008 * out + [0, 0, SOIL], (0.05 + 0.01 * (i % 2)) * out + [0, 0, SOIL + 0.06 + 0.03 * (i % 2)]
        task.add_part(plant, f"plant_stem{i}", task.CAPSULE, [0.003], [0, 0, 0], green, fromto=[*root, *tip])
        task.add_part(plant, f"plant_leaf{i}", task.ELLIPSOID, [0.022, 0.018, 0.008], tip, green)

    can = task.add_object(spec, "waterer", 0.0)
    blue, light = [0.15, 0.35, 0.75, 1], {"mass": 0.001}
    hidden = {"group": task.INVISIBLE_GROUP, "mass": 0.15}
    box = [BODY - 0.003, BODY - 0.003, BODY_TOP / 2]
    task.add_part(can, "waterer", task.BOX, box, [0, 0, BODY_TOP / 2], blue, OBJECT, **hidden)
    task.add_part(can, "waterer_body", task.CYLINDER, [BODY, BODY_TOP / 2], [0, 0, BODY_TOP / 2], blue, **light)
    bar = {"fromto": [-BAR, 0, HANDLE_TOP, BAR, 0, HANDLE_TOP], "mass": 0.01}
    dark = [0.1, 0.2, 0.45, 1]
    task.add_part(can, "waterer_handle", task.CAPSULE, [HANDLE], [0, 0, 0], dark, OBJECT, **bar)
    for i, x in enumerate((BAR - 0.005, 0.005 - BAR)):
        strut = {"fromto": [x, 0, BODY_TOP, x, 0, HANDLE_TOP], **light}
        task.add_part(can, f"waterer_strut{i}", task.CAPSULE, [0.006], [0, 0, 0], dark, **strut)
    spout = {"fromto": [BODY - 0.01, 0, 0.03, *HEAD], **light}
    task.add_part(can, "waterer_spout", task.CAPSULE, [0.009], [0, 0, 0], blue, **spout)
    task.add_part(can, "waterer_head", task.SPHERE, [ROSE], HEAD, dark, **light)

    for name in DROPS:
        # The damping stops it where it lands, and leaves its fall fast enough.
        drop = task.add_object(spec, name, HEAD[2], damping=0.01)
        task.add_part(drop, name, task.SPHERE, [DROP], [0, 0, 0], [0.35, 0.7, 1.0, 1], DROP_BITS, mass=0.002)


def _sample(key: Array, variation: Array) -> task.Placement:
    # The spout points to the robot's left, within reach of a hand that leans to pour; the front camera sees both sides.
    low, high = jnp.array([0.14, -0.04, jnp.pi / 2 - 0.6]), jnp.array([0.22, 0.04, jnp.pi / 2 + 0.6])
    x, y, yaw = jax.random.uniform(key, (3,), minval=low, maxval=high)
    root = task.upright_pose(x, y, TABLE_HEIGHT, yaw)

    def at(pose: Array, point: Array) -> Array:
        return pose.at[:3].set(task.point_in_world(pose, point))

    can = at(root, jnp.array([CAN, 0.0, 0.0]))
    drops = {name: at(can, place) for name, place in zip(DROPS, HEAD + RING, strict=True)}
    return task.Placement(mocap={"plant": at(root, jnp.array([PLANT, 0.0, 0.0]))}, free={"waterer": can, **drops})


def _handle(view: task.StateView) -> Array:
    return task.point_in_world(view.body_pose("waterer"), (0.0, 0.0, HANDLE_TOP))


def _head(view: task.StateView) -> tuple[Array, Array]:
    """The head of the can in the frame of the plant: distance () from the pot's axis, and height ()."""
    head = task.point_in_world(view.body_pose("waterer"), HEAD)
    x, y, z = task.point_in_body(view.body_pose("plant"), head)
    return jnp.hypot(x, y), z


def _keypoints(view: task.StateView) -> Array:
    """The handle of the can, then the plant in its pot."""
    return jnp.stack([_handle(view), task.point_in_world(view.body_pose("plant"), (0.0, 0.0, SOIL + 0.03))])[None]


def _brought(view: task.StateView) -> Array:
    distance, _ = _head(view)
    return view.holds("waterer") & (distance < NEAR) & (view.body_pose("waterer")[2] > TABLE_HEIGHT + LIFTED)


def _pours(view: task.StateView) -> Array:
    distance, height = _head(view)
    spout = rotations.quaternion_rotate(view.body_pose("waterer")[3:], jnp.array([1.0, 0.0, 0.0]))
    low, high = POUR
    return (distance < OVER) & (height > low) & (height < high) & (spout[2] < -np.sin(DIP))


def _success(view: task.StateView) -> Array:
    """All drops are in the pot."""
    plant = view.body_pose("plant")
    drops = jnp.stack([task.point_in_body(plant, view.body_pose(name)[:3]) for name in DROPS])
    return jnp.all((jnp.hypot(drops[:, 0], drops[:, 1]) < POT + DROP) & (drops[:, 2] < SOIL + 2 * DROP))


def _expert(view: task.StateView) -> Action:
    can, handle = view.body_pose("waterer"), _handle(view)
    head_goal = task.point_in_world(view.body_pose("plant"), (0.0, 0.0, POUR_HEIGHT))
    offset = HEAD - np.array([0.0, 0.0, HANDLE_TOP], np.float32)
    down = rotations.quaternion_multiply(can[3:], rotations.DOWN)
    positions = [handle.at[2].add(APPROACH), handle, handle.at[2].add(LIFT)]
    turns = [down] * 3
    for tilt in TILTS:
        # The hand tilts with the can, about the axis along which its fingers open.
        lean = rotations.quaternion_from_axis_angle(jnp.array([0.0, 1.0, 0.0]), jnp.float32(tilt))
        turn = rotations.quaternion_multiply(can[3:], lean)
        positions.append(head_goal - rotations.quaternion_rotate(turn, jnp.asarray(offset)))
        turns.append(rotations.quaternion_multiply(turn, rotations.DOWN))
    return task.keyframes(positions, [task.OPEN] + [task.CLOSED] * 5, jnp.stack(turns))


TASK = task.Task(
    name="water_plants",
    num_arms=1,
    build=_build,
    sample=_sample,
    instructions=(
        "water plant",
        "pour some water on the plant",
        "take the watering can and water the plant",
        "pick up the watering can by its handle and pour water onto the plant",
        "give the plant some water",
    ),
    recognised_by=r"\bplants?\b|\bwatering\b",
    objects=(
        task.TaskObject("watering can", "waterer_.*"),
        task.TaskObject("green plant", "plant_.*"),
    ),
    keypoints=_keypoints,
    success=_success,
    expert=_expert,
    stages=(_brought,),
    graspables=(task.Graspable("waterer", (BAR, HANDLE, HANDLE), (0.0, 0.0, HANDLE_TOP)),),
    attachments=tuple(
        task.Attachment(name, "waterer", (float(place[0]), float(place[1]), float(place[2])))
        for name, place in zip(DROPS, HEAD + RING, strict=True)
    ),
    release=_pours,
)
