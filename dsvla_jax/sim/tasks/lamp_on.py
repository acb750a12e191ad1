"""Press the button of a desk lamp. RLBench: lamp_on."""

import jax
import jax.numpy as jnp
import mujoco

from dsvla_jax.sim.robot import FIXTURE
from dsvla_jax.sim.tasks import task
from dsvla_jax.types import TABLE_HEIGHT, Action, Array

BUTTON = (0.0, 0.12, 0.045)  # the top of the released button, in the frame of the root
LAMP = (0.0, -0.09)  # the foot of the lamp
TRAVEL = 0.012
PRESSED = 0.003
# Heights of the two keyframes over the button, metres. The press is so deep that it works when given 2 cm too high.
ABOVE, PRESS = 0.10, -0.03


def _build(spec: mujoco.MjSpec) -> None:
    root = task.add_furniture(spec, "lamp")
    x, y, top = BUTTON
    # The lamp is only looked at: colliding, it would cost contacts at every step.
    task.add_part(root, "lamp_foot", task.CYLINDER, [0.06, 0.01], [*LAMP, 0.01], [0.25, 0.25, 0.3, 1])
    task.add_part(root, "lamp_pole", task.CYLINDER, [0.009, 0.085], [*LAMP, 0.105], [0.7, 0.7, 0.72, 1])
    task.add_part(root, "lamp_bulb", task.SPHERE, [0.03], [*LAMP, 0.195], [1.0, 0.95, 0.6, 1])
    task.add_part(root, "lamp_shade", task.CYLINDER, [0.055, 0.03], [*LAMP, 0.235], [0.85, 0.45, 0.15, 1])
    task.add_part(root, "lamp_switch", task.BOX, [0.04, 0.04, 0.0125], [x, y, 0.0125], [0.15, 0.15, 0.15, 1])

    button = root.add_body(name="lamp_button", pos=[x, y, top], gravcomp=1.0)
    joint = button.add_joint(name="lamp_button", type=task.SLIDE, axis=[0, 0, -1], range=[0.0, TRAVEL], limited=True)
    joint.stiffness[0], joint.damping[0] = 200.0, 5.0
    # An upright capsule whose dome is the button.
    green = [0.1, 0.75, 0.2, 1]
    task.add_part(button, "lamp_button", task.CAPSULE, [0.024, 0.003], [0, 0, -0.027], green, FIXTURE, mass=0.05)


def _sample(key: Array, variation: Array) -> task.Placement:
    low, high = jnp.array([0.12, -0.12, -jnp.pi]), jnp.array([0.22, 0.12, jnp.pi])
    x, y, yaw = jax.random.uniform(key, (3,), minval=low, maxval=high)
    return task.Placement(mocap={"lamp": task.upright_pose(x, y, TABLE_HEIGHT, yaw)})


def _button(view: task.StateView) -> Array:
    x, y, top = BUTTON
    return task.point_in_world(view.body_pose("lamp"), jnp.stack([x, y, top - view.joint("lamp_button")]))


def _keypoints(view: task.StateView) -> Array:
    """The top of the button."""
    return _button(view)[None, None]


def _success(view: task.StateView) -> Array:
    return view.joint("lamp_button") > PRESSED


def _expert(view: task.StateView) -> Action:
    button = _button(view)
    heights = jnp.array([[0.0, 0.0, ABOVE], [0.0, 0.0, PRESS]])
    return task.keyframes(button + heights, [task.CLOSED, task.CLOSED])


TASK = task.Task(
    name="lamp_on",
    num_arms=1,
    build=_build,
    sample=_sample,
    instructions=(
        "turn on the light",
        "press the button to turn on the lamp",
        "press the light switch",
        "turn the lamp on",
        "push the green light switch to turn on the lamp",
    ),
    recognised_by=r"\blamp\b|\blight\b",
    objects=(task.TaskObject("little green light switch", "lamp_button"),),
    keypoints=_keypoints,
    success=_success,
    expert=_expert,
    colours_matter=True,
)
