"""Draw a knife out of its slanted block and lay it on a chopping board. RLBench: put_knife_on_chopping_board."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from dsvla_jax.geometry import rotations
from dsvla_jax.sim.robot import OBJECT_AND_FIXTURE, SURFACE
from dsvla_jax.sim.tasks import task
from dsvla_jax.types import TABLE_HEIGHT, Action, Array

# The block's frame is in its middle and leans with it: x up along the knife, which sticks out at that end.
SLANT = 0.6  # radians: how far the knife points up from the horizontal
BLOCK_SIZE, BLOCK_HEIGHT = (0.06, 0.04, 0.045), 0.078  # half extents; of the middle over the table, metres
IN_BLOCK = (0.065, 0.0, 0.015)  # the origin of the knife in the block's frame
# The knife's frame: x from the blade to the handle, z out of the flat of the blade; the origin is where the two meet.
HANDLE, HANDLE_LENGTH, HANDLE_RADIUS = (0.05, 0.0, 0.0), 0.045, 0.011  # middle, half of its length
BLADE = 0.1  # length
MIDDLE = (-0.01, 0.0, 0.0)  # of the whole knife
BOARD_SIZE = (0.12, 0.085, 0.009)  # half extents
APPROACH, PULL, OVER = 0.09, 0.13, 0.12  # metres before the handle, along the knife, and over the board


def _build(spec: mujoco.MjSpec) -> None:
    block = task.add_furniture(spec, "knife_block")
    walnut, dark, maple = [0.33, 0.18, 0.09, 1], [0.08, 0.08, 0.09, 1], [0.93, 0.82, 0.6, 1]
    level = [float(np.cos(SLANT / 2)), 0.0, float(np.sin(SLANT / 2)), 0.0]
    turn = np.array([[np.cos(SLANT), 0, np.sin(SLANT)], [0, 1, 0], [-np.sin(SLANT), 0, np.cos(SLANT)]])
    task.add_part(block, "knife_block", task.BOX, BLOCK_SIZE, [0, 0, 0], walnut)
    task.add_part(block, "knife_block_slot", task.BOX, [0.001, 0.025, 0.004], [BLOCK_SIZE[0], 0, IN_BLOCK[2]], dark)
    # A level foot and a leg under the overhang.
    for name, size, place in (
        ("foot", [0.065, 0.04, 0.005], [0.01, 0.0, 0.005 - BLOCK_HEIGHT]),
        ("leg", [0.008, 0.03, 0.02], [0.045, 0.0, 0.028 - BLOCK_HEIGHT]),
    ):
        task.add_part(block, f"knife_block_{name}", task.BOX, size, turn @ place, walnut, quat=level)

    board = task.add_furniture(spec, "knife_board")
    task.add_part(board, "knife_board", task.BOX, BOARD_SIZE, [0, 0, BOARD_SIZE[2]], maple, SURFACE)
    hole = [-BOARD_SIZE[0] + 0.018, 0, BOARD_SIZE[2]]
    task.add_part(board, "knife_board_hole", task.CYLINDER, [0.009, BOARD_SIZE[2] + 0.001], hole, dark)

    knife = task.add_object(spec, "knife", 0.3, damping=1e-4)
    along_x, along_y = [0.7071068, 0, 0.7071068, 0], [0.7071068, 0.7071068, 0, 0]
    size = [HANDLE_RADIUS, HANDLE_LENGTH - HANDLE_RADIUS]
    task.add_part(knife, "knife_handle", task.CAPSULE, size, HANDLE, dark, OBJECT_AND_FIXTURE, mass=0.06, quat=along_x)
    # The blade lies on a short capsule across its tip, which costs fewer contacts than a box.
    task.add_part(
        knife,
        "knife_tip",
        task.CAPSULE,
        [0.006, 0.008],
        [-BLADE + 0.01, 0, 0.006 - HANDLE_RADIUS],
        dark,
        OBJECT_AND_FIXTURE,
        mass=0.02,
        quat=along_y,
        group=task.INVISIBLE_GROUP,
    )
    silver, low = [0.85, 0.87, 0.9, 1], 0.004 - HANDLE_RADIUS
    task.add_part(
        knife, "knife_blade", task.BOX, [BLADE / 2 + 0.005, 0.015, 0.002], [-BLADE / 2 + 0.01, 0, low], silver
    )


def _sample(key: Array, variation: Array) -> task.Placement:
    side_key, block_key, board_key = jax.random.split(key, 3)
    side = jnp.where(jax.random.bernoulli(side_key), 1.0, -1.0)
    # The handle leans towards the board, sideways for the robot: the gripper must reach it along the slant.
    low, high = jnp.array([0.08, 0.13, jnp.pi / 2 - 0.6]), jnp.array([0.2, 0.19, jnp.pi / 2 + 0.8])
    x, y, yaw = jax.random.uniform(block_key, (3,), minval=low, maxval=high)
    block = task.upright_pose(x, side * y, TABLE_HEIGHT + BLOCK_HEIGHT, -side * yaw)
    slant = rotations.quaternion_from_axis_angle(jnp.array([0.0, 1.0, 0.0]), -SLANT)
    block = block.at[3:].set(rotations.quaternion_multiply(block[3:], slant))
    knife = jnp.concatenate([task.point_in_world(block, IN_BLOCK), block[3:]])
    x, y, yaw = jax.random.uniform(board_key, (3,), minval=low, maxval=high)
    board = task.upright_pose(x, -side * y, TABLE_HEIGHT, -side * yaw)
    return task.Placement(mocap={"knife_block": block, "knife_board": board}, free={"knife": knife})


def _keypoints(view: task.StateView) -> Array:
    """The middle of the knife's handle, then the middle of the board."""
    board = task.point_in_world(view.body_pose("knife_board"), (0.0, 0.0, 2 * BOARD_SIZE[2]))
    return jnp.stack([task.point_in_world(view.body_pose("knife"), HANDLE), board])[None]


def _success(view: task.StateView) -> Array:
    """The middle of the knife is on the board, and the knife has been let go."""
    x, y, z = task.point_in_body(
        view.body_pose("knife_board"), task.point_in_world(view.body_pose("knife"), jnp.array(MIDDLE))
    )
    inside = (jnp.abs(x) < BOARD_SIZE[0]) & (jnp.abs(y) < BOARD_SIZE[1]) & (z < 0.05)
    return inside & view.holds_nothing()


def _along(pose: Array) -> Array:
    """Returns the quaternion (4,) of a gripper onto the flat of a knife that lies along the x axis of ``pose`` (7,).

    Of the two ways to hold it, the one that the wrist reaches; both bodies head to the same side.
    """
    turn = jnp.where(task.yaw_of(pose) < 0, jnp.pi, 0.0)
    turned = rotations.quaternion_from_axis_angle(jnp.array([0.0, 0.0, 1.0]), turn)
    return rotations.quaternion_multiply(rotations.quaternion_multiply(pose[3:], turned), rotations.DOWN)


def _expert(view: task.StateView) -> Action:
    knife, board = view.body_pose("knife"), view.body_pose("knife_board")
    x, y, z = HANDLE
    grasp, place = _along(knife), _along(board)
    laid = (x - MIDDLE[0], 0.0, 2 * BOARD_SIZE[2] + HANDLE_RADIUS + 0.004)
    positions = [
        task.point_in_world(knife, (x, y, z + APPROACH)),
        task.point_in_world(knife, (x, y, z)),
        task.point_in_world(knife, (x + PULL, y, z)),
        task.point_in_world(board, (laid[0], laid[1], laid[2] + OVER)),
        task.point_in_world(board, laid),
    ]
    turns = jnp.stack([grasp, grasp, grasp, place, place])
    return task.keyframes(positions, [task.OPEN, task.CLOSED, task.CLOSED, task.CLOSED, task.OPEN], turns)


TASK = task.Task(
    name="put_knife_on_chopping_board",
    num_arms=1,
    build=_build,
    sample=_sample,
    instructions=(
        "put the knife on the chopping board",
        "take the knife out of the knife block and lay it on the cutting board",
        "pull the knife from its block and leave it on the chopping board",
        "place the knife onto the board",
        "pick up the knife and set it down on the chopping board",
    ),
    recognised_by=r"\bknife\b",
    objects=(
        task.TaskObject("knife", "knife_(handle|blade)"),
        task.TaskObject("small chopping board on table", "knife_board.*"),
    ),
    keypoints=_keypoints,
    success=_success,
    expert=_expert,
    graspables=(task.Graspable("knife", (HANDLE_LENGTH, HANDLE_RADIUS, HANDLE_RADIUS), HANDLE),),
    attachments=(task.Attachment("knife", "knife_block", IN_BLOCK),),
    release=lambda view: view.holds("knife"),
)
