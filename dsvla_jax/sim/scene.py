"""One task's MuJoCo model: the table, the arms, the task's bodies, and where all of them are in the state's arrays."""

from collections.abc import Sequence
from dataclasses import dataclass

import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct

from dsvla_jax.geometry import rotations
from dsvla_jax.sim import robot
from dsvla_jax.sim.physics import SimState
from dsvla_jax.sim.tasks import Placement, StateLayout, StateView, Task
from dsvla_jax.sim.tasks.task import Link, LinkJoint
from dsvla_jax.types import TABLE_HEIGHT, Array

TABLE_RGBA = (0.62, 0.47, 0.34, 1.0)
CLUTTER = "clutter"  # begins the names of things that stand about and are only looked at
_CLUTTER_SHAPES = (
    (mujoco.mjtGeom.mjGEOM_BOX, (0.03, 0.025, 0.05)),
    (mujoco.mjtGeom.mjGEOM_SPHERE, (0.035, 0.0, 0.0)),
    (mujoco.mjtGeom.mjGEOM_CYLINDER, (0.03, 0.06, 0.0)),
    (mujoco.mjtGeom.mjGEOM_BOX, (0.05, 0.03, 0.015)),
    (mujoco.mjtGeom.mjGEOM_CAPSULE, (0.02, 0.05, 0.0)),
    (mujoco.mjtGeom.mjGEOM_CYLINDER, (0.045, 0.02, 0.0)),
)


@dataclass(frozen=True, eq=False)
class GraspableBody:
    """A body that a closing gripper is welded to.

    body: body id. half_extents, centre: float32 (3,), metres, in its frame.
    welds: int (A,), the equality constraint to each arm's hand. They begin inactive; their anchor and relative pose
        (eq_data) are written when the object is grasped.
    """

    body: int
    half_extents: np.ndarray
    centre: np.ndarray
    welds: np.ndarray


@dataclass(frozen=True, eq=False)
class Scene:
    """A compiled task.

    shifts: the names of the test conditions under which its episodes begin, see `sim/shifts.py`.
    arms: the left arm first; a single arm is called left. graspables: in the task's order.
    attachments: int, the equality constraints of the task's attachments.
    initial: qpos (nq,), ctrl (nu,), mocap_pos (nmocap, 3), mocap_quat (nmocap, 4) wxyz and geom_rgba (ngeom, 4), all
        float32: the arms at their start, the task's bodies where they were built.
    """

    task: Task
    mj_model: mujoco.MjModel
    layout: StateLayout
    arms: tuple[robot.Arm, ...]
    graspables: tuple[GraspableBody, ...]
    attachments: np.ndarray
    initial: "SceneState"
    shifts: tuple[str, ...] = ()

    @property
    def welds(self) -> np.ndarray:
        """int (A, N): the equality constraint between each hand and each graspable."""
        return np.array([g.welds for g in self.graspables], np.int32).reshape(len(self.graspables), len(self.arms)).T

    def view(self, state: SimState) -> StateView:
        """What the task's functions read, of one example."""
        return StateView(
            qpos=state.qpos,
            mocap_pos=state.mocap_pos,
            mocap_quat=state.mocap_quat,
            held=state.eq_active[self.welds],
            variation=state.variation,
            layout=self.layout,
        )

    def place(self, placement: Placement) -> "SceneState":
        """The state in which an episode begins. Pure; vmap it over placements."""
        state, layout = self.initial, self.layout
        qpos, pos, quat, rgba = state.qpos, state.mocap_pos, state.mocap_quat, state.geom_rgba
        for name, pose in placement.mocap.items():
            index = layout.mocap_index(name)
            pos = pos.at[index].set(pose[:3])
            quat = quat.at[index].set(rotations.quaternion_to_wxyz(pose[3:]))
        for name, pose in placement.free.items():
            address = layout.free_address(name)
            wxyz = rotations.quaternion_to_wxyz(pose[3:])
            qpos = qpos.at[address : address + 7].set(jnp.concatenate([pose[:3], wxyz]))
        for name, value in placement.joints.items():
            qpos = qpos.at[layout.joint_address(name)].set(value)
        for name, colour in placement.rgba.items():
            rgba = rgba.at[self.mj_model.geom(name).id].set(colour)
        return SceneState(qpos=qpos, ctrl=state.ctrl, mocap_pos=pos, mocap_quat=quat, geom_rgba=rgba)


@struct.dataclass
class SceneState:
    """What a placement decides; see `Scene.initial` for the shapes."""

    qpos: Array
    ctrl: Array
    mocap_pos: Array
    mocap_quat: Array
    geom_rgba: Array


def build_scene(task: Task, shifts: tuple[str, ...] = ()) -> Scene:
    """Compiles the model of a task, with clutter, out of sight until it is placed, if "background" is among the shifts.

    Raises ValueError for a task with another number of arms than 1 or 2.
    """
    spec = mujoco.MjSpec()
    robot.set_physics_options(spec)
    spec.worldbody.add_geom(
        name="table",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        pos=[0, 0, TABLE_HEIGHT],
        size=[2.0, 2.0, 0.1],
        rgba=list(TABLE_RGBA),
        contype=robot.TABLE.contype,
        conaffinity=robot.TABLE.conaffinity,
    )
    bases = {1: (robot.SINGLE_BASE,), 2: robot.DUAL_BASES}.get(task.num_arms)
    if bases is None:
        raise ValueError(f"task {task.name!r}: num_arms is {task.num_arms}, expected 1 or 2")
    prefixes = robot.ARM_PREFIXES[: task.num_arms]
    for prefix, base in zip(prefixes, bases, strict=True):
        robot.add_panda(spec, prefix, base)
    task.build(spec)
    for i, (shape, size) in enumerate(_CLUTTER_SHAPES if "background" in shifts else ()):
        body = spec.worldbody.add_body(name=f"{CLUTTER}{i}", mocap=True, pos=[0, 0, -1])
        body.add_geom(name=f"{CLUTTER}{i}", type=shape, size=size, contype=0, conaffinity=0)
    for graspable in task.graspables:
        for prefix in prefixes:
            _add_weld(spec, f"{prefix}hand", graspable.body)
    for attachment in task.attachments:
        _add_weld(spec, attachment.carrier, attachment.body, attachment.position, active=True)
    model = spec.compile()

    arms = tuple(robot.find_arm(model, prefix) for prefix in prefixes)
    layout = _layout(model, arms, tuple(graspable.body for graspable in task.graspables))
    return Scene(
        task=task,
        mj_model=model,
        layout=layout,
        arms=arms,
        graspables=tuple(
            GraspableBody(
                body=model.body(g.body).id,
                half_extents=np.asarray(g.half_extents, np.float32),
                centre=np.asarray(g.centre, np.float32),
                welds=np.array([model.equality(_weld_name(f"{prefix}hand", g.body)).id for prefix in prefixes]),
            )
            for g in task.graspables
        ),
        attachments=np.array([model.equality(_weld_name(a.carrier, a.body)).id for a in task.attachments], np.int32),
        initial=_initial_state(model, arms),
        shifts=shifts,
    )


def _weld_name(carrier: str, body: str) -> str:
    return f"{carrier}_holds_{body}"


def _add_weld(
    spec: mujoco.MjSpec, carrier: str, body: str, position: Sequence[float] = (0.0, 0.0, 0.0), active: bool = False
) -> None:
    weld = spec.add_equality(
        name=_weld_name(carrier, body),
        type=mujoco.mjtEq.mjEQ_WELD,
        name1=carrier,
        name2=body,
        objtype=mujoco.mjtObj.mjOBJ_BODY,
        active=active,
    )
    # anchor (3), relative position (3), relative quaternion wxyz (4), torque scale
    weld.data[:11] = [0, 0, 0, *position, 1, 0, 0, 0, 1]
    weld.solref = [0.01, 1.0]


def _layout(model: mujoco.MjModel, arms: tuple[robot.Arm, ...], graspables: tuple[str, ...]) -> StateLayout:
    free, joints = {}, {}
    prefixes = tuple(arm.prefix for arm in arms)
    for i in range(model.njnt):
        joint = model.joint(i)
        if joint.type[0] == mujoco.mjtJoint.mjJNT_FREE:
            free[model.body(joint.bodyid[0]).name] = int(joint.qposadr[0])
        elif not joint.name.startswith(prefixes):
            joints[joint.name] = int(joint.qposadr[0])
    bodies = [model.body(i) for i in range(model.nbody)]
    mocap = {body.name: int(body.mocapid[0]) for body in bodies if body.mocapid[0] >= 0}
    links = {}
    for body in bodies:  # parents come first
        parent = bodies[body.parentid[0]].name
        if parent in {*free, *mocap, *links}:
            links[body.name] = _link(model, body.id, parent)
    return StateLayout(free=free, mocap=mocap, joints=joints, links=links, graspables=graspables, arms=arms)


def _link(model: mujoco.MjModel, body_id: int, parent: str) -> Link:
    body = model.body(body_id)
    w, x, y, z = body.quat.tolist()
    joints = [model.joint(body.jntadr[0] + i) for i in range(body.jntnum[0])]
    if any(joint.type[0] == mujoco.mjtJoint.mjJNT_BALL for joint in joints):
        raise ValueError(f"body {body.name!r} has a ball joint; a StateView knows hinges and slides")
    return Link(
        parent=parent,
        pose=(*body.pos.tolist(), x, y, z, w),
        joints=tuple(
            LinkJoint(
                kind=joint.type[0],
                address=int(joint.qposadr[0]),
                axis=tuple(joint.axis.tolist()),
                anchor=tuple(joint.pos.tolist()),
                zero=float(joint.qpos0[0]),
            )
            for joint in joints
        ),
    )


def _initial_state(model: mujoco.MjModel, arms: tuple[robot.Arm, ...]) -> SceneState:
    data = mujoco.MjData(model)
    qpos, ctrl = model.qpos0.astype(np.float32), np.zeros(model.nu, np.float32)
    for arm in arms:
        robot.set_start(arm, qpos, ctrl)
    arrays = (qpos, ctrl, data.mocap_pos, data.mocap_quat, model.geom_rgba)
    return SceneState(*(jnp.asarray(array, jnp.float32) for array in arrays))
