"""Push the lid of an open laptop shut from behind. RLBench: close_laptop_lid."""

import jax
import jax.numpy as jnp
import mujoco

from dsvla_jax.sim.robot import FIXTURE
from dsvla_jax.sim.tasks import task
from dsvla_jax.types import TABLE_HEIGHT, Action, Array

# The root's frame lies under the middle of the laptop: x along the hinge, -y towards who types.
WIDTH, DEPTH = 0.24, 0.16  # metres, along x and y
STAND, BASE, LID = 0.04, 0.02, 0.005  # heights of the stand and of the base on it, half the thickness of the lid
HINGE = (DEPTH / 2 - 0.005, STAND + BASE)  # y and z
OPEN_ANGLE, CLOSED_BY = 1.85, 1.79  # radians: how far the lid stands open, and how much less is success
# The expert pushes with closed fingers: distance of its tool centre point from the hinge, how far behind the lid it
# begins and from what height it comes there, half the width of the fingers, the angle at which its push ends, and how
# deep it presses the lid down.
RADIUS, CLEARANCE, ABOVE, PAD, PUSHED_ANGLE, PRESS = 0.125, 0.06, 0.12, 0.012, 1.0, 0.01


def _build(spec: mujoco.MjSpec) -> None:
    root = task.add_furniture(spec, "laptop")
    silver, dark, black = [0.78, 0.8, 0.83, 1], [0.12, 0.12, 0.14, 1], [0.2, 0.2, 0.22, 1]
    x, y, top = WIDTH / 2, DEPTH / 2, HINGE[1]
    stand = [0.7 * x, 0.7 * y, STAND / 2 + 0.001]
    task.add_part(root, "laptop_stand", task.BOX, stand, [0, 0, STAND / 2], [0.45, 0.3, 0.55, 1])
    task.add_part(root, "laptop_base", task.BOX, [x, y, BASE / 2], [0, 0, STAND + BASE / 2], silver, FIXTURE)
    task.add_part(root, "laptop_keyboard", task.BOX, [x - 0.02, 0.035, 0.001], [0, 0.03, top], dark)
    for i in range(3):
        row = [0, 0.05 - 0.02 * i, top + 0.001]
        task.add_part(root, f"laptop_keys{i}", task.BOX, [x - 0.028, 0.006, 0.001], row, [0.4, 0.4, 0.42, 1])
    task.add_part(root, "laptop_touchpad", task.BOX, [0.035, 0.02, 0.001], [0, -0.045, top], black)

    lid = root.add_body(name="laptop_lid", pos=[0, *HINGE])
    joint = lid.add_joint(name="laptop_lid", type=task.HINGE, axis=[-1, 0, 0], range=[0.0, OPEN_ANGLE], limited=True)
    joint.frictionloss, joint.damping[0], joint.armature = 0.05, 0.02, 0.005
    # At angle zero the lid lies on the base.
    half = [x, y - 0.005, LID]
    task.add_part(lid, "laptop_lid", task.BOX, half, [0, -half[1], LID + 0.002], silver, FIXTURE, mass=0.2)
    screen = [x - 0.012, half[1] - 0.012, LID]
    task.add_part(lid, "laptop_screen", task.BOX, screen, [0, -half[1], LID + 0.001], [0.25, 0.55, 0.9, 1], mass=0)
    logo = [0, -half[1], 2 * LID + 0.002]
    task.add_part(lid, "laptop_logo", task.CYLINDER, [0.018, 0.001], logo, black, mass=0)


def _sample(key: Array, variation: Array) -> task.Placement:
    # Nearer or farther, some turns of the laptop would put the space behind its lid out of reach.
    low, high = jnp.array([0.17, -0.12, -jnp.pi]), jnp.array([0.24, 0.12, jnp.pi])
    x, y, yaw = jax.random.uniform(key, (3,), minval=low, maxval=high)
    return task.Placement(
        mocap={"laptop": task.upright_pose(x, y, TABLE_HEIGHT, yaw)},
        joints={"laptop_lid": jnp.float32(OPEN_ANGLE)},
    )


def _on_lid(view: task.StateView, angle: Array | float, radius: float, outwards: float) -> Array:
    """A world point on the middle line of the lid, open by ``angle``, ``outwards`` behind its outer face."""
    angle, out = jnp.asarray(angle), outwards + 2 * LID + 0.002
    y = HINGE[0] - radius * jnp.cos(angle) + out * jnp.sin(angle)
    z = HINGE[1] + radius * jnp.sin(angle) + out * jnp.cos(angle)
    return task.point_in_world(view.body_pose("laptop"), jnp.stack([0.0 * angle, y, z]))


def _keypoints(view: task.StateView) -> Array:
    """The middle of the lid's upper edge."""
    return _on_lid(view, view.joint("laptop_lid"), DEPTH - 0.01, -LID)[None, None]


def _success(view: task.StateView) -> Array:
    return view.joint("laptop_lid") < OPEN_ANGLE - CLOSED_BY


def _expert(view: task.StateView) -> Action:
    behind = _on_lid(view, view.joint("laptop_lid"), RADIUS, CLEARANCE)
    pushed = _on_lid(view, PUSHED_ANGLE, RADIUS, PAD)
    pressed = _on_lid(view, 0.0, RADIUS, -PRESS)
    above = behind + jnp.array([0.0, 0.0, ABOVE])
    return task.keyframes([above, behind, pushed, pressed], [task.CLOSED] * 4)


TASK = task.Task(
    name="close_laptop_lid",
    num_arms=1,
    build=_build,
    sample=_sample,
    instructions=(
        "close laptop lid",
        "close the laptop",
        "shut the lid of the laptop",
        "push the screen of the laptop down until it is closed",
        "fold the laptop shut",
    ),
    recognised_by=r"\blaptop\b",
    objects=(task.TaskObject("laptop", "laptop_(?!stand).*"),),
    keypoints=_keypoints,
    success=_success,
    expert=_expert,
)
