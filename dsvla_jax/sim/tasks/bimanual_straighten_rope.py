"""Pull both ends of a crumpled rope onto two green squares. RLBench (two arms): bimanual_straighten_rope.

The rope is a chain of capsules with upright hinges: it bends in the plane of the table, and a lifted end lifts all.
"""

import jax
import jax.numpy as jnp
import mujoco

from dsvla_jax.geometry import rotations
from dsvla_jax.sim.robot import OBJECT, CollisionBits
from dsvla_jax.sim.tasks import task
from dsvla_jax.types import TABLE_HEIGHT, Action, Array

LINKS, LENGTH, RADIUS = 8, 0.05, 0.009  # of a link, metres
HALF = (LENGTH / 2, 0.0, 0.0)  # the middle of a link, in its frame: the first and the last one are grasped there
SQUARE, NEAR = 0.03, 0.035  # half an edge of a green square; how far from its middle the rope's end may lie
# In the frame of the root: how far to each side the squares are, a little less than the straight rope would reach, and
# how far from the rope.
SPREAD, ASIDE = 0.172, 0.11
# How far the links turn away from the line between the squares, in parts of the rope's sway; each may differ by NOISE.
SHAPE = (-0.8, -0.45, 0.0, 0.45, 0.45, 0.0, -0.45, -0.8)
SWAY, NOISE = (1.1, 1.6), 0.1  # radians
ABOVE, GRASP = 0.09, 0.012  # heights of the tool centre point over the table

ENDS = ("rope_tail", "rope_head")  # the left arm takes the tail
TARGETS = ("rope_tail_target", "rope_head_target")
MIDDLE_BITS = CollisionBits(0, 1)  # lies on the table; the ends alone meet the fingers


def _build(spec: mujoco.MjSpec) -> None:
    for name in TARGETS:
        square = task.add_furniture(spec, name)
        task.add_part(square, name, task.BOX, [SQUARE, SQUARE, 0.001], [0, 0, 0.001], [0.1, 0.7, 0.2, 1])

    red, tip = [0.8, 0.1, 0.1, 1], [0.5, 0.05, 0.08, 1]
    names = [ENDS[0], *(f"rope_{i}" for i in range(1, LINKS - 1)), ENDS[1]]
    link = task.add_object(spec, names[0], RADIUS)
    for i, name in enumerate(names):
        if i > 0:
            link = link.add_body(name=name, pos=[LENGTH, 0, 0])
            upright = {"type": task.HINGE, "axis": [0, 0, 1], "range": [-1.5, 1.5], "limited": True}
            joint = link.add_joint(name=f"rope_joint{i}", **upright)
            joint.damping[0], joint.armature = 0.005, 0.001
        along = {"quat": [0.70710678, 0, 0.70710678, 0], "mass": 0.03}
        colour, bits = (tip, OBJECT) if name in ENDS else (red, MIDDLE_BITS)
        task.add_part(link, name, task.CAPSULE, [RADIUS, LENGTH / 2], HALF, colour, bits, **along)


def _sample(key: Array, variation: Array) -> task.Placement:
    place_key, sway_key, sign_key, noise_key = jax.random.split(key, 4)
    # The arms keep to their sides: turned by more, RLBench's rope would have to change them.
    low, high = jnp.array([0.14, -0.04, -jnp.pi / 8]), jnp.array([0.2, 0.04, jnp.pi / 8])
    x, y, yaw = jax.random.uniform(place_key, (3,), minval=low, maxval=high)
    root = task.upright_pose(x, y, TABLE_HEIGHT, yaw)
    bend, aside = jax.random.rademacher(sign_key, (2,), jnp.float32)
    sway = bend * jax.random.uniform(sway_key, (), minval=SWAY[0], maxval=SWAY[1])
    noise = jax.random.uniform(noise_key, (LINKS,), minval=-NOISE, maxval=NOISE)
    headings = -jnp.pi / 2 + sway * jnp.asarray(SHAPE) + noise
    steps = LENGTH * jnp.stack([jnp.cos(headings), jnp.sin(headings), jnp.zeros(LINKS)], axis=-1)
    tail = task.point_in_world(root, -jnp.sum(steps, axis=0) / 2)
    bends = jnp.diff(headings)
    squares = [task.point_in_world(root, jnp.stack([aside * ASIDE, side, 0.0])) for side in (SPREAD, -SPREAD)]
    return task.Placement(
        mocap={
            name: task.upright_pose(square[0], square[1], square[2], yaw)
            for name, square in zip(TARGETS, squares, strict=True)
        },
        free={ENDS[0]: task.upright_pose(tail[0], tail[1], TABLE_HEIGHT + RADIUS, yaw + headings[0])},
        joints={f"rope_joint{i + 1}": bends[i] for i in range(LINKS - 1)},
    )


def _ends(view: task.StateView) -> Array:
    """The points (2, 3) at which the rope is grasped."""
    return jnp.stack([task.point_in_world(view.body_pose(end), HALF) for end in ENDS])


def _squares(view: task.StateView) -> Array:
    """The middles (2, 3) of the squares' tops."""
    return jnp.stack([task.point_in_world(view.body_pose(name), (0.0, 0.0, 0.002)) for name in TARGETS])


def _keypoints(view: task.StateView) -> Array:
    """For each arm its end of the rope, then the square for it."""
    return jnp.stack([_ends(view), _squares(view)], axis=1)


def _success(view: task.StateView) -> Array:
    """Both ends lie on their squares."""
    offsets = _ends(view) - _squares(view)
    return jnp.all(jnp.linalg.norm(offsets, axis=-1) < NEAR)


def _expert(view: task.StateView) -> Action:
    up, arms = jnp.array([0.0, 0.0, 1.0]), []
    for name, end, square in zip(ENDS, _ends(view), _squares(view), strict=True):
        # The hand keeps the link between its fingers: turned into the line of the squares, the rope ends up straight.
        # Half a turn more than the link's own keeps the wrist off its limit.
        yaws = jnp.stack([task.yaw_of(view.body_pose(name)), task.yaw_of(view.body_pose(TARGETS[0])) - jnp.pi / 2])
        turns = rotations.quaternion_multiply(
            jax.vmap(lambda yaw: rotations.quaternion_from_axis_angle(up, yaw))(jnp.mod(yaws + jnp.pi, 2 * jnp.pi)),
            rotations.DOWN,
        )
        positions = [point.at[2].set(TABLE_HEIGHT + z) for point, z in ((end, ABOVE), (end, GRASP), (square, GRASP))]
        grippers = [task.OPEN, task.CLOSED, task.OPEN]
        arms.append(task.keyframes(positions, grippers, turns[jnp.array([0, 0, 1])]))
    return task.both_arms(*arms)


TASK = task.Task(
    name="bimanual_straighten_rope",
    num_arms=2,
    build=_build,
    sample=_sample,
    instructions=(
        "straighten rope",
        "straighten the rope",
        "pull the rope straight",
        "grasp each end of the rope in order to pull it straight",
        "put the ends of the red rope on the green squares",
    ),
    recognised_by=r"\brope\b",
    objects=(
        task.TaskObject(("red rope (one end)", "red rope (other end)"), r"rope_(tail|head|\d+)"),
        task.TaskObject("green block", "rope_.*_target"),
    ),
    keypoints=_keypoints,
    success=_success,
    expert=_expert,
    graspables=tuple(task.Graspable(end, (LENGTH / 2, RADIUS, RADIUS), HALF) for end in ENDS),
    rests_on={TARGETS[1]: TARGETS[0]},  # the rope is as long as they are apart
    colours_matter=True,
)
