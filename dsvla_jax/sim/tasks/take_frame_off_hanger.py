"""Take a picture frame off its peg on a wall and stand it on the table. RLBench: take_frame_off_hanger."""

import jax
import jax.numpy as jnp
import mujoco

from dsvla_jax.geometry import rotations
from dsvla_jax.sim.robot import OBJECT
from dsvla_jax.sim.tasks import task
from dsvla_jax.types import TABLE_HEIGHT, Action, Array

# The frame, metres. The root's frame lies on the table under the hanging frame; its x axis points out of the wall.
HALF, THICKNESS, BAR = 0.075, 0.012, 0.011  # half an outer edge, half the thickness, half the width of a bar
HANGS = 0.165  # height of the middle of the hanging frame
WALL = -0.065  # the wall's surface: fingers fit behind the frame. It is low enough for the hand to reach over it
PEG, PEG_END = HANGS + HALF + 0.012, 0.03  # the peg's height, and how far out it reaches
# Success: the frame has left the peg, at most OUT from the wall and ASIDE, and stands lower than STANDS.
OUT, ASIDE, STANDS = 0.26, 0.12, HALF + 0.02
# The expert: it takes the upper bar beside the peg and stands the frame PULL away, a little over the table.
BESIDE, APPROACH, PULL, DROP = 0.045, 0.08, 0.15, 0.004
GRASP = HALF - 0.003  # height of the tool centre point over the frame's middle
ACROSS = (0.70710678, -0.70710678, 0.0, 0.0)  # straight down, one finger before and one behind the frame
LANDING = (PULL, 0.0, 0.01)


def _build(spec: mujoco.MjSpec) -> None:
    root = task.add_furniture(spec, "hanger")
    plaster, steel, wood = [0.55, 0.68, 0.72, 1], [0.25, 0.25, 0.27, 1], [0.35, 0.17, 0.07, 1]
    top = (HANGS + HALF + 0.025) / 2
    task.add_part(root, "hanger_wall", task.BOX, [0.01, 0.15, top], [WALL - 0.01, 0, top], plaster)
    task.add_part(root, "hanger_foot", task.BOX, [0.04, 0.15, 0.008], [WALL - 0.061, 0, 0.008], plaster)
    along = [0.7071068, 0, 0.7071068, 0]
    middle, half = (WALL + PEG_END) / 2, (PEG_END - WALL) / 2
    task.add_part(root, "hanger_peg", task.CAPSULE, [0.005, half], [middle, 0, PEG], steel, quat=along)

    # The frame collides as one board. It hangs by an attachment: a loop over a peg would be many small contacts.
    frame = task.add_object(spec, "frame", HANGS, damping=1e-3)
    board = [THICKNESS, HALF, HALF]
    task.add_part(frame, "frame", task.BOX, board, [0, 0, 0], wood, OBJECT, mass=0.1, group=task.INVISIBLE_GROUP)
    inner = HALF - 2 * BAR
    for i, side in enumerate((1, -1)):
        at = side * (HALF - BAR)
        task.add_part(frame, f"frame_bar{i}", task.BOX, [THICKNESS, HALF, BAR], [0, 0, at], wood)
        task.add_part(frame, f"frame_side{i}", task.BOX, [THICKNESS, BAR, inner], [0, at, 0], wood)
        string = {"fromto": [0, side * 0.03, HALF - 0.002, 0, 0, PEG - HANGS + 0.007]}
        task.add_part(frame, f"frame_string{i}", task.CAPSULE, [0.0025], [0, 0, 0], [0.9, 0.9, 0.85, 1], **string)
    # A landscape: sky, a meadow and the sun.
    half, depth = inner / 2, THICKNESS / 2
    task.add_part(frame, "frame_sky", task.BOX, [depth, inner, half], [0, 0, half], [0.45, 0.72, 0.95, 1])
    task.add_part(frame, "frame_meadow", task.BOX, [depth, inner, half], [0, 0, -half], [0.25, 0.6, 0.2, 1])
    task.add_part(frame, "frame_sun", task.SPHERE, [0.017], [0, 0.02, 0.028], [0.98, 0.85, 0.2, 1])


def _sample(key: Array, variation: Array) -> task.Placement:
    # The picture faces the front camera: turned further, the wall would hide it.
    low, high = jnp.array([0.04, -0.12, -jnp.pi / 4]), jnp.array([0.12, 0.12, jnp.pi / 4])
    x, y, yaw = jax.random.uniform(key, (3,), minval=low, maxval=high)
    root = task.upright_pose(x, y, TABLE_HEIGHT, yaw)
    return task.Placement(mocap={"hanger": root}, free={"frame": root.at[2].add(HANGS)})


def _grip(view: task.StateView) -> Array:
    return task.point_in_world(view.body_pose("frame"), (0.0, BESIDE, GRASP))


def _keypoints(view: task.StateView) -> Array:
    """Where to take the frame, on its upper bar, then where to stand it on the table."""
    return jnp.stack([_grip(view), task.point_in_world(view.body_pose("hanger"), LANDING)])[None]


def _success(view: task.StateView) -> Array:
    x, y, z = task.point_in_body(view.body_pose("hanger"), view.body_pose("frame")[:3])
    return (x > PEG_END) & (x < OUT) & (jnp.abs(y) < ASIDE) & (z < STANDS) & view.holds_nothing()


def _expert(view: task.StateView) -> Action:
    root, grip = view.body_pose("hanger"), _grip(view)
    quaternion = rotations.quaternion_multiply(root[3:], jnp.array(ACROSS))
    out = task.point_in_world(root, (PULL, 0.0, 0.0)) - root[:3]
    down = jnp.array([0.0, 0.0, HALF + DROP - HANGS])
    positions = [grip + jnp.array([0.0, 0.0, APPROACH]), grip, grip + out, grip + out + down]
    return task.keyframes(positions, [task.OPEN, task.CLOSED, task.CLOSED, task.OPEN], quaternion)


TASK = task.Task(
    name="take_frame_off_hanger",
    num_arms=1,
    build=_build,
    sample=_sample,
    instructions=(
        "take frame off hanger",
        "take the picture down from the wall",
        "remove the frame from the hanger and put it on the table",
        "unhang the picture frame and stand it on the table",
        "lift the frame off its peg and set it down",
    ),
    recognised_by=r"\b(frame|picture)\b",
    objects=(task.TaskObject("frame", "frame_(?!string).*"),),
    keypoints=_keypoints,
    success=_success,
    expert=_expert,
    graspables=(task.Graspable("frame", (THICKNESS, HALF, HALF)),),
    attachments=(task.Attachment("frame", "hanger", (0.0, 0.0, HANGS)),),
    release=lambda view: view.holds("frame"),
)
