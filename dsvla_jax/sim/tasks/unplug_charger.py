"""Pull a charger out of its socket on an upright board. RLBench: unplug_charger."""

import jax
import jax.numpy as jnp
import mujoco

from dsvla_jax.sim.robot import FIXTURE, OBJECT
from dsvla_jax.sim.tasks import task
from dsvla_jax.types import TABLE_HEIGHT, Action, Array

# The board's frame stands on the table under the middle of its face: x out of the face, z up.
BOARD_SIZE = (0.01, 0.12, 0.11)  # half extents, metres
PLATE = 0.004  # thickness of the socket's plate
CHARGER_SIZE = (0.024, 0.016, 0.02)
# Near the top of the board, where the hand has room above the board.
PLUGGED = (PLATE + CHARGER_SIZE[0], 0.0, 0.185)  # the charger's middle in the board's frame
PRONG = 0.02  # length
OUT = 0.05  # how far the charger must be pulled
APPROACH, PULL = 0.08, 0.117  # metres over the charger, and out of the socket


def _build(spec: mujoco.MjSpec) -> None:
    board = task.add_furniture(spec, "charger_board")
    cream, white, black, metal = (
        [0.85, 0.8, 0.68, 1],
        [0.97, 0.97, 0.97, 1],
        [0.06, 0.06, 0.07, 1],
        [0.75, 0.72, 0.6, 1],
    )
    x, _, height = BOARD_SIZE
    task.add_part(board, "charger_board", task.BOX, BOARD_SIZE, [-x, 0, height], cream, FIXTURE)
    task.add_part(board, "charger_plate", task.BOX, [PLATE, 0.035, 0.03], [0, 0, PLUGGED[2]], white)
    for i, y in enumerate((0.007, -0.007)):
        hole = [PLATE + 0.001, 0.003, 0.005]
        task.add_part(board, f"charger_hole{i}", task.BOX, hole, [0, y, PLUGGED[2]], black)

    charger = task.add_object(spec, "charger", PLUGGED[2], damping=1e-4)
    # What collides is a capsule, which costs less than the box that is seen.
    task.add_part(
        charger,
        "charger_core",
        task.CAPSULE,
        [CHARGER_SIZE[1], CHARGER_SIZE[0] - CHARGER_SIZE[1]],
        [0, 0, 0],
        black,
        OBJECT,
        mass=0.05,
        quat=[0.7071068, 0, 0.7071068, 0],
        group=task.INVISIBLE_GROUP,
    )
    task.add_part(charger, "charger", task.BOX, CHARGER_SIZE, [0, 0, 0], black)
    for i, y in enumerate((0.007, -0.007)):
        place = [-CHARGER_SIZE[0] - PRONG / 2 + 0.001, y, 0]
        task.add_part(charger, f"charger_prong{i}", task.BOX, [PRONG / 2, 0.0015, 0.0035], place, metal)
    task.add_part(charger, "charger_light", task.SPHERE, [0.005], [CHARGER_SIZE[0], 0, 0.008], [0.2, 0.9, 0.3, 1])


def _sample(key: Array, variation: Array) -> task.Placement:
    low, high = jnp.array([0.03, -0.22, -jnp.pi / 4]), jnp.array([0.2, 0.22, jnp.pi / 4])
    x, y, yaw = jax.random.uniform(key, (3,), minval=low, maxval=high)
    board = task.upright_pose(x, y, TABLE_HEIGHT, yaw)
    charger = jnp.concatenate([task.point_in_world(board, PLUGGED), board[3:]])
    return task.Placement(mocap={"charger_board": board}, free={"charger": charger})


def _keypoints(view: task.StateView) -> Array:
    """The middle of the charger."""
    return view.body_pose("charger")[:3][None, None]


def _success(view: task.StateView) -> Array:
    """The charger is in front of the board, farther from it than its prongs are long."""
    place = task.point_in_body(view.body_pose("charger_board"), view.body_pose("charger")[:3])
    return place[0] > PLUGGED[0] + OUT


def _expert(view: task.StateView) -> Action:
    charger = view.body_pose("charger")
    offsets = ((0.0, 0.0, APPROACH), (0.0, 0.0, 0.0), (PULL, 0.0, 0.0))
    positions = [task.point_in_world(charger, offset) for offset in offsets]
    return task.keyframes(positions, [task.OPEN, task.CLOSED, task.CLOSED], task.pointing_down(task.yaw_of(charger)))


TASK = task.Task(
    name="unplug_charger",
    num_arms=1,
    build=_build,
    sample=_sample,
    instructions=(
        "unplug charger",
        "unplug the charger from the socket",
        "pull the black charger out of the board",
        "grasp the charger and pull it out of the wall socket",
        "remove the plug from its socket",
    ),
    recognised_by=r"\bcharger\b|\bplug\b",
    objects=(task.TaskObject("the smallest black charger on vertical board", "charger(_prong.|_light)?"),),
    keypoints=_keypoints,
    success=_success,
    expert=_expert,
    graspables=(task.Graspable("charger", CHARGER_SIZE),),
    attachments=(task.Attachment("charger", "charger_board", PLUGGED),),
    release=lambda view: view.holds("charger"),
    colours_matter=True,
)
