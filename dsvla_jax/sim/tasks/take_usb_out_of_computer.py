"""Pull a USB stick out of the front of a computer and put it down. RLBench: take_usb_out_of_computer."""

import jax
import jax.numpy as jnp
import mujoco

from dsvla_jax.sim.robot import FIXTURE, OBJECT
from dsvla_jax.sim.tasks import task
from dsvla_jax.types import TABLE_HEIGHT, Action, Array

# The computer's frame stands on the table under the middle of its front: x out of the front, z up.
COMPUTER_SIZE = (0.09, 0.045, 0.1)  # half extents, metres
PANEL = 0.004  # how far the front panel stands out
STICK_SIZE = (0.024, 0.01, 0.009)  # of the part outside the computer
CONNECTOR = 0.014  # length
# Near the top of the computer, where the hand has room above it.
PLUGGED = (PANEL + STICK_SIZE[0], 0.0, 0.175)  # the stick's middle in the computer's frame
OUT = 0.03  # how far from its port the stick counts as taken out
APPROACH, PULL, RELEASE = 0.08, 0.1, 0.02  # metres over the stick, out of the port, and over the table


def _build(spec: mujoco.MjSpec) -> None:
    computer = task.add_furniture(spec, "usb_computer")
    dark, panel, black = [0.22, 0.23, 0.26, 1], [0.5, 0.52, 0.56, 1], [0.05, 0.05, 0.06, 1]
    x, y, z = COMPUTER_SIZE
    task.add_part(computer, "usb_computer", task.BOX, COMPUTER_SIZE, [-x, 0, z], dark, FIXTURE)
    task.add_part(computer, "usb_panel", task.BOX, [PANEL, y - 0.006, z - 0.008], [0, 0, z], panel)
    task.add_part(computer, "usb_port", task.BOX, [PANEL + 0.001, 0.018, 0.009], [0, 0, PLUGGED[2]], black)
    for i, height in enumerate((0.145, 0.125)):
        task.add_part(computer, f"usb_drive{i}", task.BOX, [PANEL + 0.001, 0.03, 0.006], [0, 0, height], dark)
    across = [0.7071068, 0, 0.7071068, 0]
    button, blue = [0, 0, 0.09], [0.2, 0.6, 1.0, 1]
    task.add_part(computer, "usb_power", task.CYLINDER, [0.011, PANEL + 0.002], button, blue, quat=across)
    for i, height in enumerate((0.055, 0.043, 0.031)):
        task.add_part(computer, f"usb_vent{i}", task.BOX, [PANEL + 0.001, 0.028, 0.003], [0, 0, height], black)

    stick = task.add_object(spec, "usb", PLUGGED[2], damping=1e-4)
    red, metal = [0.9, 0.1, 0.1, 1], [0.8, 0.82, 0.85, 1]
    # What collides is a capsule, which costs less than the box that is seen.
    task.add_part(
        stick,
        "usb_core",
        task.CAPSULE,
        [STICK_SIZE[2], STICK_SIZE[0] - STICK_SIZE[2]],
        [0, 0, 0],
        red,
        OBJECT,
        mass=0.03,
        quat=across,
        group=task.INVISIBLE_GROUP,
    )
    task.add_part(stick, "usb", task.BOX, STICK_SIZE, [0, 0, 0], red)
    place = [-STICK_SIZE[0] - CONNECTOR / 2 + 0.001, 0, 0]
    task.add_part(stick, "usb_connector", task.BOX, [CONNECTOR / 2, 0.007, 0.0035], place, metal)


def _sample(key: Array, variation: Array) -> task.Placement:
    # Turned further, the computer would stand between the front camera and the stick.
    low, high = jnp.array([0.03, -0.2, -1.4]), jnp.array([0.18, 0.2, 1.4])
    x, y, yaw = jax.random.uniform(key, (3,), minval=low, maxval=high)
    computer = task.upright_pose(x, y, TABLE_HEIGHT, yaw)
    stick = jnp.concatenate([task.point_in_world(computer, PLUGGED), computer[3:]])
    return task.Placement(mocap={"usb_computer": computer}, free={"usb": stick})


def _keypoints(view: task.StateView) -> Array:
    """The middle of the stick."""
    return view.body_pose("usb")[:3][None, None]


def _success(view: task.StateView) -> Array:
    """The stick is out of its port and has been let go."""
    place = task.point_in_body(view.body_pose("usb_computer"), view.body_pose("usb")[:3])
    return (jnp.linalg.norm(place - jnp.array(PLUGGED)) > OUT) & view.holds_nothing()


def _expert(view: task.StateView) -> Action:
    stick = view.body_pose("usb")
    offsets = ((0.0, 0.0, APPROACH), (0.0, 0.0, 0.0), (PULL, 0.0, 0.0), (PULL, 0.0, RELEASE - PLUGGED[2]))
    positions = [task.point_in_world(stick, offset) for offset in offsets]
    grippers = [task.OPEN, task.CLOSED, task.CLOSED, task.OPEN]
    return task.keyframes(positions, grippers, task.pointing_down(task.yaw_of(stick)))


TASK = task.Task(
    name="take_usb_out_of_computer",
    num_arms=1,
    build=_build,
    sample=_sample,
    instructions=(
        "take usb out of computer",
        "pull the usb stick out of the computer",
        "remove the red usb stick from the pc",
        "unplug the usb stick from the front of the computer and put it down",
        "grasp the usb and pull it out of its port",
    ),
    recognised_by=r"\busb\b",
    objects=(task.TaskObject("small usb", "usb(_connector)?"),),
    keypoints=_keypoints,
    success=_success,
    expert=_expert,
    graspables=(task.Graspable("usb", STICK_SIZE),),
    attachments=(task.Attachment("usb", "usb_computer", PLUGGED),),
    release=lambda view: view.holds("usb"),
    colours_matter=True,
)
