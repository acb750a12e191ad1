"""Lay the handset of a desk telephone on its base. RLBench: phone_on_base."""

import jax
import jax.numpy as jnp
import mujoco

from dsvla_jax.sim.robot import FIXTURE, OBJECT_AND_FIXTURE
from dsvla_jax.sim.tasks import task
from dsvla_jax.types import TABLE_HEIGHT, Action, Array

# In the frame of the root: the middles of the base and of the place where the handset begins, along its y axis.
BASE, BESIDE = -0.1, 0.12
BASE_SIZE = (0.1, 0.08, 0.025)  # half extents, metres
# The handset lies along x: its ends stand on whatever is below, its handle bridges them.
ENDS, END_RADIUS, HANDLE_RADIUS, HANDLE_RISE = 0.072, 0.016, 0.012, 0.012
# Where the handset lies on the base, in the frame of the base, which is under the base's middle.
CRADLE = (0.0, 0.045, 2 * BASE_SIZE[2] + END_RADIUS)
TOLERANCE = (0.04, 0.03, 0.02)  # of the handset's place on the base that counts, to either side
APPROACH, LIFT = 0.10, 0.16  # metres over the handset where it lies


def _build(spec: mujoco.MjSpec) -> None:
    base = task.add_furniture(spec, "phone_base")
    red, white, grey, dark = [0.8, 0.12, 0.1, 1], [0.93, 0.92, 0.88, 1], [0.5, 0.51, 0.54, 1], [0.2, 0.2, 0.22, 1]
    top = 2 * BASE_SIZE[2]
    task.add_part(base, "phone_base", task.BOX, BASE_SIZE, [0, 0, BASE_SIZE[2]], red, FIXTURE)
    task.add_part(base, "phone_base_dial", task.CYLINDER, [0.034, 0.004], [0, -0.036, top + 0.003], white)
    task.add_part(base, "phone_base_hub", task.CYLINDER, [0.014, 0.004], [0, -0.036, top + 0.006], red)
    # The prongs that the handle lies between are only looked at.
    for i, (x, y) in enumerate(((0.035, 0.022), (0.035, -0.022), (-0.035, 0.022), (-0.035, -0.022))):
        size, middle = [0.008, 0.005, 0.014], [x, CRADLE[1] + y, top + 0.012]
        task.add_part(base, f"phone_base_prong{i}", task.BOX, size, middle, dark)

    phone = task.add_object(spec, "phone", END_RADIUS, damping=1e-3)
    size, along_x, along_y = [HANDLE_RADIUS, ENDS], [0.7071068, 0, 0.7071068, 0], [0.7071068, 0.7071068, 0, 0]
    handle = [0, 0, HANDLE_RISE]
    task.add_part(phone, "phone_handle", task.CAPSULE, size, handle, grey, FIXTURE, mass=0.05, quat=along_x)
    for i, x in enumerate((ENDS, -ENDS)):
        # What collides is a capsule across, which costs less than the box that is seen.
        task.add_part(
            phone,
            f"phone_end{i}",
            task.CAPSULE,
            [END_RADIUS, 0.012],
            [x, 0, 0],
            grey,
            OBJECT_AND_FIXTURE,
            mass=0.05,
            quat=along_y,
            group=task.INVISIBLE_GROUP,
        )
        task.add_part(phone, f"phone_ear{i}", task.BOX, [0.025, 0.028, 0.015], [x, 0, 0], grey)


def _sample(key: Array, variation: Array) -> task.Placement:
    low, high = jnp.array([0.1, -0.15, -jnp.pi]), jnp.array([0.24, 0.15, jnp.pi])
    x, y, yaw = jax.random.uniform(key, (3,), minval=low, maxval=high)
    root = task.upright_pose(x, y, TABLE_HEIGHT, yaw)
    base, phone = task.point_in_world(root, (0.0, BASE, 0.0)), task.point_in_world(root, (0.0, BESIDE, END_RADIUS))
    return task.Placement(
        mocap={"phone_base": jnp.concatenate([base, root[3:]])}, free={"phone": jnp.concatenate([phone, root[3:]])}
    )


def _handle(view: task.StateView) -> Array:
    return task.point_in_world(view.body_pose("phone"), (0.0, 0.0, HANDLE_RISE))


def _keypoints(view: task.StateView) -> Array:
    """The middle of the handset's handle, then its place on the base."""
    return jnp.stack([_handle(view), task.point_in_world(view.body_pose("phone_base"), CRADLE)])[None]


def _success(view: task.StateView) -> Array:
    """The handset lies on the cradle and has been let go."""
    place = task.point_in_body(view.body_pose("phone_base"), view.body_pose("phone")[:3])
    return jnp.all(jnp.abs(place - jnp.array(CRADLE)) < jnp.array(TOLERANCE)) & view.holds_nothing()


def _expert(view: task.StateView) -> Action:
    handle, base = _handle(view), view.body_pose("phone_base")
    x, y, z = CRADLE
    cradle = task.point_in_world(base, (x, y, z + HANDLE_RISE))
    up = jnp.array([0.0, 0.0, 1.0])
    # It is let go 5 mm over the cradle.
    positions = [handle + APPROACH * up, handle, handle + LIFT * up, cradle + APPROACH * up, cradle + 0.005 * up]
    grasp, place = task.pointing_down(task.yaw_of(view.body_pose("phone"))), task.pointing_down(task.yaw_of(base))
    turns = jnp.stack([grasp, grasp, grasp, place, place])
    return task.keyframes(positions, [task.OPEN, task.CLOSED, task.CLOSED, task.CLOSED, task.OPEN], turns)


TASK = task.Task(
    name="phone_on_base",
    num_arms=1,
    build=_build,
    sample=_sample,
    instructions=(
        "put the phone on the base",
        "place the phone on its red base",
        "pick up the grey phone and lay it on the phone base",
        "hang up the phone",
        "put the handset back on the telephone",
    ),
    recognised_by=r"phone\b|\bhandset\b",
    objects=(
        task.TaskObject("grey phone near the red base on the desk", "phone_(handle|ear.)"),
        task.TaskObject("red phone base", "phone_base.*"),
    ),
    keypoints=_keypoints,
    success=_success,
    expert=_expert,
    graspables=(task.Graspable("phone", (0.04, HANDLE_RADIUS, HANDLE_RADIUS), (0.0, 0.0, HANDLE_RISE)),),
    colours_matter=True,
)
