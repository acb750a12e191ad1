"""What a manipulation task is: bodies, where they are put, words, keypoints, a predicate and a scripted expert.

A task never sees a simulator's memory. It reads object poses and joint values by name from a `StateView`, which is
computed from qpos and the poses of the mocap bodies alone, so a predicate can be evaluated at every physics step.
All functions of a task are per example and pure jnp; vmap them over episodes.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct

from dsvla_jax.geometry import rotations
from dsvla_jax.sim.robot import VISUAL, CollisionBits
from dsvla_jax.types import TABLE_HEIGHT, Action, Array

BOX = mujoco.mjtGeom.mjGEOM_BOX
SPHERE = mujoco.mjtGeom.mjGEOM_SPHERE
CAPSULE = mujoco.mjtGeom.mjGEOM_CAPSULE
CYLINDER = mujoco.mjtGeom.mjGEOM_CYLINDER  # to look at only: MJX has no cylinder-box contacts
HINGE = mujoco.mjtJoint.mjJNT_HINGE
SLIDE = mujoco.mjtJoint.mjJNT_SLIDE
INVISIBLE_GROUP = 3  # geoms of this group collide but are not drawn

OPEN, CLOSED = 1.0, 0.0


@dataclasses.dataclass(frozen=True)
class StateLayout:
    """Where the named things of one model are: the static half of a `StateView`."""

    free: Mapping[str, int]  # body -> address of its free joint in qpos
    mocap: Mapping[str, int]  # body -> index into mocap_pos and mocap_quat
    joints: Mapping[str, int]  # hinge or slide joint -> address in qpos

    # A layout belongs to one model, and is compared by identity so that it can be static under jit.
    __hash__ = object.__hash__
    __eq__ = object.__eq__

    def address(self, table: str, name: str) -> int:
        """The address of ``name`` in ``free``, ``mocap`` or ``joints``; an error that lists what there is."""
        known: Mapping[str, int] = getattr(self, table)
        if name not in known:
            raise KeyError(f"no {table} entry {name!r} in this scene; it has {sorted(known)}")
        return known[name]


@struct.dataclass
class StateView:
    """The state of one example, read by name.

    qpos: float32 (nq,). mocap_pos: float32 (nmocap, 3). mocap_quat: float32 (nmocap, 4), MuJoCo's order wxyz.
    """

    qpos: Array
    mocap_pos: Array
    mocap_quat: Array
    layout: StateLayout = struct.field(pytree_node=False)

    def body_pose(self, name: str) -> Array:
        """The world pose (7,), quaternion xyzw, of a loose object or of a piece of furniture (a mocap body)."""
        if name in self.layout.mocap:
            i = self.layout.mocap[name]
            return jnp.concatenate([self.mocap_pos[i], rotations.quaternion_from_wxyz(self.mocap_quat[i])])
        address = self.layout.address("free", name)
        pose = jax.lax.dynamic_slice_in_dim(self.qpos, address, 7)
        return jnp.concatenate([pose[:3], rotations.quaternion_from_wxyz(pose[3:])])

    def joint(self, name: str) -> Array:
        """The value () of a hinge (radians) or a slide (metres)."""
        return self.qpos[self.layout.address("joints", name)]


@struct.dataclass
class Placement:
    """Where an episode begins. Poses are (7,), world frame, quaternion xyzw; what is not named stays as built.

    mocap: furniture by body name. free: loose objects by body name. joints: values by joint name.
    rgba: colours (4,) by geom name.
    """

    mocap: dict[str, Array] = struct.field(default_factory=dict)
    free: dict[str, Array] = struct.field(default_factory=dict)
    joints: dict[str, Array] = struct.field(default_factory=dict)
    rgba: dict[str, Array] = struct.field(default_factory=dict)


@dataclasses.dataclass(frozen=True)
class Graspable:
    """A loose object that a closing gripper attaches to, if the tool centre point is within (about) its box.

    half_extents: metres, in the body's frame.
    """

    body: str
    half_extents: tuple[float, float, float]


@dataclasses.dataclass(frozen=True)
class Task:
    """One task. ``view`` arguments are of one example; M is the number of the expert's keyframes.

    build: adds the task's bodies to an MjSpec that has the table; names begin with the task's own words.
    sample: PRNG key -> Placement.
    instructions: ways to say the task; the first is the plain one.
    keypoints: view -> float32 (A, K, 3), for each arm the points to go to, in the order of the instruction.
    success: view -> bool ().
    expert: view at reset -> Action with a leading axis M: the key poses of a demonstration.
    """

    name: str
    num_arms: int
    build: Callable[[Any], None]
    sample: Callable[[Array], Placement]
    instructions: tuple[str, ...]
    keypoints: Callable[[StateView], Array]
    success: Callable[[StateView], Array]
    expert: Callable[[StateView], Action]
    graspables: tuple[Graspable, ...] = ()


def add_part(
    body: Any, name: str, shape: Any, size: Any, pos: Any, rgba: Any, collision: CollisionBits = VISUAL, **more: Any
) -> Any:
    """Adds a geom to an MjsBody: half extents or (radius, half length) ``size``, metres. Only looked at by default."""
    size = [*size, *[0.0] * (3 - len(size))]
    bits = {"contype": collision.contype, "conaffinity": collision.conaffinity}
    return body.add_geom(name=name, type=shape, size=size, pos=list(pos), rgba=list(rgba), **bits, **more)


def add_furniture(spec: Any, name: str) -> Any:
    """Adds a body without weight that stands where the placement puts it (a mocap body). Returns the MjsBody."""
    return spec.worldbody.add_body(name=name, mocap=True, pos=[0.0, 0.0, TABLE_HEIGHT])


def add_object(spec: Any, name: str, height: float, damping: float = 0.0) -> Any:
    """Adds a loose body whose origin begins ``height`` metres above the table. ``damping`` slows moving and rolling."""
    body = spec.worldbody.add_body(name=name, pos=[0.0, 0.0, TABLE_HEIGHT + height])
    joint = body.add_freejoint(name=name)
    joint.damping = np.full_like(joint.damping, damping)
    return body


def upright_pose(x: Array, y: Array, z: Array | float, yaw: Array | float = 0.0) -> Array:
    """The pose (7,) at (x, y, z) turned by ``yaw`` radians about the vertical."""
    position = jnp.stack([jnp.asarray(x), jnp.asarray(y), jnp.asarray(z)]).astype(jnp.float32)
    up = jnp.array([0.0, 0.0, 1.0], jnp.float32)
    return jnp.concatenate([position, rotations.quaternion_from_axis_angle(up, jnp.asarray(yaw, jnp.float32))])


def point_in_world(pose: Array, point: Any) -> Array:
    """A point (3,) of a body's frame, in the world. pose (7,), point (3,) -> (3,)."""
    return pose[:3] + rotations.quaternion_rotate(pose[3:], jnp.asarray(point, jnp.float32))


def point_in_body(pose: Array, point: Array) -> Array:
    """A point (3,) of the world, in a body's frame. pose (7,), point (3,) -> (3,)."""
    return rotations.quaternion_rotate(rotations.quaternion_conjugate(pose[3:]), point - pose[:3])


def key_poses(positions: Any, grippers: list[float], quaternion: Any = rotations.DOWN) -> Action:
    """The keyframes of one arm with one constant orientation: M positions (3,) -> Action with axes (M, 1, ...)."""
    points = jnp.stack([jnp.asarray(position, jnp.float32) for position in positions])
    turns = jnp.broadcast_to(jnp.asarray(quaternion, jnp.float32), (len(points), 4))
    return Action(
        pose=jnp.concatenate([points, turns], axis=-1)[:, None],
        gripper_open=jnp.asarray(grippers, jnp.float32)[:, None],
    )
