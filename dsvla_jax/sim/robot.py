"""A Franka Panda of primitive shapes, built into a MuJoCo spec.

Link transforms, joint limits and masses are Franka's published ones (https://frankaemika.github.io/docs, and the
Panda of mujoco_menagerie, from which the inertias' diagonals are taken too); the shapes are capsules and boxes, cheap
to collide and to ray-cast. Only the hand and the two fingers collide.

The tool centre point (TCP) lies between the finger tips, 0.1034 m from the hand's frame; the fingers reach 9 mm beyond
it. Its z axis is the approach direction and its y axis the direction in which the fingers open. Its x axis is chosen
so that a gripper straight down in front of the robot has the quaternion [0, 1, 0, 0] (xyzw), as in RLBench.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

_R = float(np.sqrt(0.5))
# Frame of each link (hand last) in its parent, at zero joint angles; every joint turns about its link's own z.
LINK_POSITIONS = np.array(
    [
        [0, 0, 0.333],
        [0, 0, 0],
        [0, -0.316, 0],
        [0.0825, 0, 0],
        [-0.0825, 0.384, 0],
        [0, 0, 0],
        [0.088, 0, 0],
        [0, 0, 0.107],
    ]
)
LINK_QUATERNIONS_WXYZ = np.array(
    [
        [1, 0, 0, 0],
        [_R, -_R, 0, 0],
        [_R, _R, 0, 0],
        [_R, _R, 0, 0],
        [_R, -_R, 0, 0],
        [_R, _R, 0, 0],
        [_R, _R, 0, 0],
        [np.cos(np.pi / 8), 0, 0, -np.sin(np.pi / 8)],
    ]
)
JOINT_LOW = np.array([-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973])
JOINT_HIGH = np.array([2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973])
TCP_POSITION = np.array([0.0, 0.0, 0.1034])  # in the hand's frame
TCP_QUATERNION_WXYZ = np.array([0.0, 0.0, 0.0, 1.0])
FINGER_TRAVEL = 0.04  # of each finger, metres

POSITION_GAINS = np.array([4500.0, 4500.0, 3500.0, 3500.0, 2000.0, 2000.0, 2000.0])
VELOCITY_GAINS = POSITION_GAINS / 10.0
TIMESTEP = 0.005

# RLBench's Panda at the start of an episode: about 10 degrees off straight down, 0.72 m above the table.
START_JOINTS = np.array([0.0, 0.175, 0.0, -0.872, 0.0, 1.221, 0.785])
SINGLE_BASE = (-0.31, 0.0, 0.752)
DUAL_BASES = ((-0.31, 0.35, 0.752), (-0.31, -0.35, 0.752))
ARM_PREFIXES = ("left_", "right_")  # a single arm is called left


@dataclass(frozen=True)
class CollisionBits:
    """MuJoCo's (contype, conaffinity) of one kind of geom.

    A pair collides if either's contype meets the other's conaffinity.
    """

    contype: int
    conaffinity: int


TABLE = CollisionBits(1, 6)
OBJECT = CollisionBits(2, 3)  # free things: hit the table, the fingers and each other
OBJECT_AND_FIXTURE = CollisionBits(2, 11)  # a free thing that also hits fixtures
FINGER = CollisionBits(4, 3)
FIXTURE = CollisionBits(8, 4)  # doors, drawers, buttons: hit the fingers, never the table
SURFACE = CollisionBits(8, 0)  # what things are laid on: hits OBJECT_AND_FIXTURE, and spares the fingers' contacts
VISUAL = CollisionBits(0, 0)

_LINK_MASSES = (4.970684, 0.646926, 3.228604, 3.587895, 1.225946, 1.666555, 0.735522)
_LINK_CENTRES = (
    (0.003875, 0.002081, -0.04762),
    (-0.003141, -0.02872, 0.003495),
    (0.027518, 0.039252, -0.066502),
    (-0.05317, 0.104419, 0.027454),
    (-0.011953, 0.041065, -0.038437),
    (0.060149, -0.014117, -0.010517),
    (0.010517, -0.004252, 0.061597),
)
_LINK_INERTIAS = (
    (0.70337, 0.70661, 0.009117),
    (0.007962, 0.02811, 0.025995),
    (0.037242, 0.036155, 0.01083),
    (0.025853, 0.019552, 0.028323),
    (0.035549, 0.029474, 0.008627),
    (0.001964, 0.004354, 0.005433),
    (0.012516, 0.010027, 0.004815),
)
# One capsule a link, (from, to, radius) in the link's frame; they overlap into the arm's outline.
_LINK_CAPSULES = (
    ((0, 0, -0.18), (0, 0, 0), 0.065),
    ((0, -0.10, 0), (0, 0.02, 0), 0.06),
    ((0, 0, -0.12), (0.06, 0, 0), 0.058),
    ((0, 0, 0), (-0.0825, 0.10, 0), 0.056),
    ((0, 0, -0.24), (0, 0.06, -0.03), 0.05),
    ((0, 0, 0), (0.088, 0, 0), 0.048),
    ((0, 0, 0.02), (0, 0, 0.09), 0.044),
)
_WHITE = (0.92, 0.92, 0.92, 1.0)
_DARK = (0.25, 0.25, 0.28, 1.0)


@dataclass(frozen=True, eq=False)
class Arm:
    """Where one arm lives in a compiled model.

    prefix: of all its names. base: float32 (7,) pose of its base in the world.
    joints: int (7,) indices into qpos. actuators: int (7,) into ctrl.
    fingers: int (2,) into qpos. gripper: the gripper's index in ctrl; its control is one finger's travel in metres.
    """

    prefix: str
    base: np.ndarray
    joints: np.ndarray
    actuators: np.ndarray
    fingers: np.ndarray
    gripper: int


GRIPPER_OPEN_CONTROL = FINGER_TRAVEL
GRIPPER_CLOSED_CONTROL = -0.01  # beyond closed, so that a thick object is squeezed nearly as hard as a thin one


def set_physics_options(spec: mujoco.MjSpec) -> None:
    """The solver settings that every scene shares. Call it before adding bodies: it also makes angles radians."""
    spec.compiler.degree = False
    option = spec.option
    option.timestep = TIMESTEP
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    option.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
    option.iterations = 5
    option.ls_iterations = 8
    option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_EULERDAMP)


def add_panda(
    spec: mujoco.MjSpec,
    prefix: str,
    base_pos: Sequence[float],
    base_quat: Sequence[float] = (0.0, 0.0, 0.0, 1.0),
) -> None:
    """Adds a Panda whose base is at ``base_pos`` (world, metres) and ``base_quat`` (xyzw). All names get ``prefix``."""
    if spec.compiler.degree:
        raise ValueError(
            "the spec reads angles as degrees, the Panda's joint ranges are radians: call set_physics_options(spec) "
            "first"
        )
    x, y, z, w = base_quat
    body = spec.worldbody.add_body(name=f"{prefix}base", pos=list(base_pos), quat=[w, x, y, z])
    _capsule(body, f"{prefix}base", (-0.06, 0, 0.06), (0, 0, 0.08), 0.07)
    for i in range(7):
        body = body.add_body(
            name=f"{prefix}link{i + 1}", pos=LINK_POSITIONS[i], quat=LINK_QUATERNIONS_WXYZ[i], gravcomp=1
        )
        _set_inertia(body, _LINK_MASSES[i], _LINK_CENTRES[i], _LINK_INERTIAS[i])
        body.add_joint(
            name=f"{prefix}joint{i + 1}",
            type=mujoco.mjtJoint.mjJNT_HINGE,
            axis=[0, 0, 1],
            range=[JOINT_LOW[i], JOINT_HIGH[i]],
            limited=True,
            armature=0.1,
        )
        _capsule(body, f"{prefix}link{i + 1}", *_LINK_CAPSULES[i])
    hand = body.add_body(name=f"{prefix}hand", pos=LINK_POSITIONS[7], quat=LINK_QUATERNIONS_WXYZ[7], gravcomp=1)
    _set_inertia(hand, 0.73, (-0.01, 0, 0.03), (0.001, 0.0025, 0.0017))
    palm = _capsule(hand, f"{prefix}hand", (0, -0.07, 0.035), (0, 0.07, 0.035), 0.03)
    palm.contype, palm.conaffinity = FINGER.contype, FINGER.conaffinity
    hand.add_site(name=f"{prefix}tcp", pos=TCP_POSITION, quat=TCP_QUATERNION_WXYZ, group=4)
    for i, sign in enumerate((1.0, -1.0)):
        _add_finger(hand, f"{prefix}finger{i + 1}", sign)

    # The fingers move together, as the real gripper's do; the actuator pulls both through their mean travel.
    spec.add_equality(
        name=f"{prefix}fingers",
        type=mujoco.mjtEq.mjEQ_JOINT,
        objtype=mujoco.mjtObj.mjOBJ_JOINT,
        name1=f"{prefix}finger2",
        name2=f"{prefix}finger1",
        data=np.array([0.0, 1.0] + [0.0] * (mujoco.mjNEQDATA - 2)),
        solref=[0.01, 1.0],
    )
    tendon = spec.add_tendon(name=f"{prefix}fingers")
    tendon.wrap_joint(f"{prefix}finger1", 0.5)
    tendon.wrap_joint(f"{prefix}finger2", 0.5)
    for i in range(7):
        actuator = spec.add_actuator(
            name=f"{prefix}joint{i + 1}", target=f"{prefix}joint{i + 1}", trntype=mujoco.mjtTrn.mjTRN_JOINT
        )
        actuator.set_to_position(kp=POSITION_GAINS[i], kv=VELOCITY_GAINS[i])
    gripper = spec.add_actuator(name=f"{prefix}gripper", target=f"{prefix}fingers", trntype=mujoco.mjtTrn.mjTRN_TENDON)
    gripper.set_to_position(kp=2000.0, kv=100.0)
    gripper.forcelimited, gripper.forcerange = True, [-80.0, 80.0]


def find_arm(model: mujoco.MjModel, prefix: str) -> Arm:
    """Looks up an arm that ``add_panda`` built."""
    base_body = model.body(f"{prefix}base")
    joints = [model.joint(f"{prefix}joint{i + 1}") for i in range(7)]
    fingers = [model.joint(f"{prefix}finger{i + 1}") for i in range(2)]
    w, x, y, z = base_body.quat
    return Arm(
        prefix=prefix,
        base=np.array([*base_body.pos, x, y, z, w], np.float32),
        joints=np.array([j.qposadr[0] for j in joints]),
        actuators=np.array([model.actuator(f"{prefix}joint{i + 1}").id for i in range(7)]),
        fingers=np.array([j.qposadr[0] for j in fingers]),
        gripper=int(model.actuator(f"{prefix}gripper").id),
    )


def set_start(arm: Arm, qpos: np.ndarray, ctrl: np.ndarray) -> None:
    """Writes the start posture, gripper open, into qpos (..., nq) and ctrl (..., nu) in place."""
    qpos[..., arm.joints] = START_JOINTS
    qpos[..., arm.fingers] = FINGER_TRAVEL
    ctrl[..., arm.actuators] = START_JOINTS
    ctrl[..., arm.gripper] = GRIPPER_OPEN_CONTROL


def _add_finger(hand: mujoco.MjsBody, name: str, sign: float) -> None:
    """A sliding finger with a rubber pad's friction; ``sign`` is the side of the hand on which it sits."""
    body = hand.add_body(name=name, pos=[0, 0, 0.0584], gravcomp=1)
    _set_inertia(body, 0.015, (0, sign * 0.006, 0.027), (4e-6, 4e-6, 1e-6))
    body.add_joint(
        name=name,
        type=mujoco.mjtJoint.mjJNT_SLIDE,
        axis=[0, sign, 0],
        range=[0, FINGER_TRAVEL],
        limited=True,
        armature=0.1,
        damping=1.0,
    )
    body.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_BOX,
        pos=[0, sign * 0.006, 0.027],
        size=[0.01, 0.006, 0.027],
        rgba=_DARK,
        mass=0,
        contype=FINGER.contype,
        conaffinity=FINGER.conaffinity,
        condim=3,
        friction=[1.5, 0.005, 0.0001],
        priority=1,
        solref=[0.01, 1.0],
        solimp=[0.95, 0.98, 0.001, 0.5, 2.0],
    )


def _set_inertia(body: mujoco.MjsBody, mass: float, centre: Sequence[float], inertia: Sequence[float]) -> None:
    body.explicitinertial = True
    body.mass, body.ipos, body.inertia = mass, list(centre), list(inertia)


def _capsule(
    body: mujoco.MjsBody, name: str, start: Sequence[float], end: Sequence[float], radius: float
) -> mujoco.MjsGeom:
    return body.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        fromto=[*start, *end],
        size=[radius, 0, 0],
        rgba=_WHITE,
        mass=0,
        contype=VISUAL.contype,
        conaffinity=VISUAL.conaffinity,
    )
