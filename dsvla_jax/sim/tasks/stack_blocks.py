"""Stack two, three or four blocks of the named colour on the green square. RLBench: stack_blocks."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from dsvla_jax.geometry import rotations
from dsvla_jax.sim.robot import FIXTURE, OBJECT, CollisionBits
from dsvla_jax.sim.tasks import colours, task
from dsvla_jax.types import TABLE_HEIGHT, Action, Array

HALF = 0.02  # half an edge of a block, metres
COUNTS = (2, 3, 4)
MOST = max(COUNTS)
TARGETS = tuple(f"stack_target{i}" for i in range(MOST))
DISTRACTORS = tuple(f"stack_distractor{i}" for i in range(MOST))
SQUARE = 0.05  # half an edge of the square
# Places of the blocks, in rows on both sides of the square: far enough from it that the hand, which is 26 cm wide,
# does not touch the tower, and from each other for the fingers.
PLACES = np.array([[x, y] for x in (0.02, 0.13, 0.24) for y in (-0.27, -0.17, 0.17, 0.27)], np.float32)
JITTER = (0.012, 0.008)
# A block counts as stacked within these distances of its place in the tower, sideways and in height.
SIDEWAYS, HEIGHT = 0.035, 0.012
APPROACH, CARRY, DROP = 0.10, 0.09, 0.004  # metres over a block, over the top of the tower, and when let go
POSES = 6  # keyframes a block

# A distractor is no part of any stack: its box stands on the table, the fingers feel a ball inside it.
TABLE_ONLY = CollisionBits(0, 1)


def _build(spec: mujoco.MjSpec) -> None:
    square = task.add_furniture(spec, "stack_square")
    task.add_part(square, "stack_square", task.BOX, [SQUARE, SQUARE, 0.0005], [0, 0, 0.0005], [0.5, 0.9, 0.5, 1])
    for name in TARGETS + DISTRACTORS:
        block = task.add_object(spec, name, HALF, damping=1e-4)
        bits, grey = OBJECT if name in TARGETS else TABLE_ONLY, [0.5, 0.5, 0.5, 1]
        task.add_part(block, name, task.BOX, [HALF] * 3, [0, 0, 0], grey, bits, mass=0.06)
        if name in DISTRACTORS:
            core = f"{name}_core"
            task.add_part(
                block, core, task.SPHERE, [HALF], [0, 0, 0], grey, FIXTURE, mass=0, group=task.INVISIBLE_GROUP
            )


def _sample(key: Array, variation: Array) -> task.Placement:
    place_key, jitter_key, turn_key, square_key, colour_key = jax.random.split(key, 5)
    places = jax.random.permutation(place_key, jnp.asarray(PLACES))[: 2 * MOST]
    places += jax.random.uniform(jitter_key, places.shape, minval=-1.0, maxval=1.0) * jnp.array(JITTER)
    turns = jax.random.uniform(turn_key, (len(places),), minval=-jnp.pi, maxval=jnp.pi)
    low, high = jnp.array([0.09, -0.03, -jnp.pi]), jnp.array([0.17, 0.03, jnp.pi])
    x, y, yaw = jax.random.uniform(square_key, (3,), minval=low, maxval=high)
    colour = variation // len(COUNTS)
    other = (colour + jax.random.randint(colour_key, (), 1, len(colours.NAMES))) % len(colours.NAMES)
    rgba = jnp.asarray(colours.RGBA)
    return task.Placement(
        mocap={"stack_square": task.upright_pose(x, y, TABLE_HEIGHT, yaw)},
        free={
            name: task.upright_pose(place[0], place[1], TABLE_HEIGHT + HALF, turn)
            for name, place, turn in zip(TARGETS + DISTRACTORS, places, turns, strict=True)
        },
        rgba=dict.fromkeys(TARGETS, rgba[colour]) | dict.fromkeys(DISTRACTORS, rgba[other]),
    )


def _words(variation: int) -> dict[str, str]:
    return {"colour": colours.NAMES[variation // len(COUNTS)], "count": str(COUNTS[variation % len(COUNTS)])}


def _count(view: task.StateView) -> Array:
    """How many blocks are to be stacked, int32 ()."""
    return jnp.array(COUNTS)[view.variation % len(COUNTS)]


def _blocks(view: task.StateView) -> Array:
    """The poses (4, 7) of the blocks of the named colour."""
    return jnp.stack([view.body_pose(name) for name in TARGETS])


def _tower(view: task.StateView) -> Array:
    """The places (4, 3) of the blocks of a tower on the square, from below."""
    heights = HALF * (2 * jnp.arange(MOST, dtype=jnp.float32) + 1)
    return view.body_pose("stack_square")[:3] + heights[:, None] * jnp.array([0.0, 0.0, 1.0])


def _nearest_first(view: task.StateView) -> Array:
    """The poses (4, 7) of the blocks in the order in which the expert stacks them."""
    blocks = _blocks(view)
    return blocks[jnp.argsort(jnp.linalg.norm(blocks[:, :3] - _tower(view)[0], axis=-1))]


def _keypoints(view: task.StateView) -> Array:
    """In turn each block to be stacked and its place in the tower."""
    points = jnp.stack([_nearest_first(view)[:, :3], _tower(view)], axis=1).reshape(2 * MOST, 3)
    return points[jnp.minimum(jnp.arange(2 * MOST), 2 * _count(view) - 1)][None]


def _success(view: task.StateView) -> Array:
    """In every storey of the tower there is a block of the named colour, and all have been let go."""
    offsets = _blocks(view)[:, None, :3] - _tower(view)[None]  # (block, storey, 3)
    there = (jnp.linalg.norm(offsets[..., :2], axis=-1) < SIDEWAYS) & (jnp.abs(offsets[..., 2]) < HEIGHT)
    stacked = jnp.any(there, axis=0) | (jnp.arange(MOST) >= _count(view))
    return jnp.all(stacked) & view.holds_nothing()


def _grasp(pose: Array) -> Array:
    """Returns the quaternion (4,) of a gripper straight down onto a block.

    Of the four ways, the one whose fingers, and with them the long side of the hand, are within 45 degrees of the x
    axis: across the way to the tower.
    """
    yaw = jnp.mod(task.yaw_of(pose) - jnp.pi / 4, jnp.pi / 2) + jnp.pi / 4
    turn = rotations.quaternion_from_axis_angle(jnp.array([0.0, 0.0, 1.0]), yaw)
    return rotations.quaternion_multiply(turn, rotations.DOWN)


def _expert(view: task.StateView) -> Action:
    up = jnp.array([0.0, 0.0, 1.0])
    place = _grasp(view.body_pose("stack_square"))

    def stack(block: Array, storey: Array) -> tuple[Array, Array]:
        carry = storey + CARRY * up
        over = block[:3].at[2].set(carry[2])
        points = [block[:3] + APPROACH * up, block[:3], over, carry, storey + DROP * up, carry]
        grasp = _grasp(block)
        return jnp.stack(points), jnp.stack([grasp, grasp, grasp, place, place, place])

    positions, turns = jax.vmap(stack)(_nearest_first(view), _tower(view))
    grippers = jnp.tile(jnp.array([task.OPEN, task.CLOSED, task.CLOSED, task.CLOSED, task.OPEN, task.OPEN]), MOST)
    # It ends when the last block has been let go.
    order = jnp.minimum(jnp.arange(POSES * MOST - 1), POSES * _count(view) - 2)
    pose = jnp.concatenate([positions, turns], axis=-1).reshape(POSES * MOST, 7)[order]
    return Action(pose=pose[:, None], gripper_open=grippers[order][:, None])


def _targets(view: task.StateView) -> Array:
    return jnp.array([name in TARGETS for name in TARGETS + DISTRACTORS])


TASK = task.Task(
    name="stack_blocks",
    num_arms=1,
    build=_build,
    sample=_sample,
    instructions=(
        "stack {count} {colour} blocks",
        "place {count} of the {colour} blocks on top of each other on the green square",
        "pick up and set down {count} {colour} blocks on top of each other",
        "build a tall tower out of {count} {colour} blocks",
        "make a stack of {count} {colour} blocks on the green square",
    ),
    recognised_by=r"\bblocks?\b",
    objects=(
        task.TaskObject("{colour} block", "stack_target0"),
        task.TaskObject("light green", "stack_square"),
    ),
    keypoints=_keypoints,
    success=_success,
    expert=_expert,
    variations=len(colours.NAMES) * len(COUNTS),
    words=_words,
    exclusive=False,
    graspables=tuple(task.Graspable(name, (HALF, HALF, HALF)) for name in TARGETS + DISTRACTORS),
    targets=_targets,
    colours_matter=True,
    rests_on=dict.fromkeys((*TARGETS[1:], *DISTRACTORS), TARGETS[0]),  # by themselves, they could collide
)
