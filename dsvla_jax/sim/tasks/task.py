"""What a manipulation task is: bodies, where they are put, words, keypoints, a predicate and a scripted expert.

A task never sees a simulator's memory. It reads object poses and joint values by name from a `StateView`, which is
computed from qpos and the poses of the mocap bodies alone, so a predicate can be evaluated at every physics step.
All functions of a task are per example and pure jnp; vmap them over episodes.
"""

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct
from jax.typing import ArrayLike

from dsvla_jax.geometry import rotations
from dsvla_jax.sim.kinematics import forward_kinematics
from dsvla_jax.sim.robot import VISUAL, Arm, CollisionBits
from dsvla_jax.types import TABLE_HEIGHT, Action, Array

BOX = mujoco.mjtGeom.mjGEOM_BOX
SPHERE = mujoco.mjtGeom.mjGEOM_SPHERE
CAPSULE = mujoco.mjtGeom.mjGEOM_CAPSULE
CYLINDER = mujoco.mjtGeom.mjGEOM_CYLINDER  # to look at only: MJX has no cylinder-box contacts
ELLIPSOID = mujoco.mjtGeom.mjGEOM_ELLIPSOID  # to look at only, as a cylinder
HINGE = mujoco.mjtJoint.mjJNT_HINGE
SLIDE = mujoco.mjtJoint.mjJNT_SLIDE
INVISIBLE_GROUP = 3  # geoms of this group collide but are not drawn

OPEN, CLOSED = 1.0, 0.0

Floats = Sequence[float] | np.ndarray


@dataclasses.dataclass(frozen=True)
class LinkJoint:
    """A hinge or a slide. address: in qpos. axis, anchor: in its body's frame. zero: the value it was built at."""

    kind: mujoco.mjtJoint
    address: int
    axis: tuple[float, ...]
    anchor: tuple[float, ...]
    zero: float


@dataclasses.dataclass(frozen=True)
class Link:
    """A body that hangs on another one. pose: (7,), in the parent's frame as it was built. joints: in their order."""

    parent: str
    pose: tuple[float, ...]
    joints: tuple[LinkJoint, ...]


@dataclasses.dataclass(frozen=True)
class StateLayout:
    """Where the named things of one model are: the static half of a `StateView`."""

    free: Mapping[str, int]  # body -> address of its free joint in qpos
    mocap: Mapping[str, int]  # body -> index into mocap_pos and mocap_quat
    joints: Mapping[str, int]  # hinge or slide joint -> address in qpos
    links: Mapping[str, Link]  # bodies that hang on a loose body or on a piece of furniture
    graspables: tuple[str, ...]  # bodies, in the task's order
    arms: tuple[Arm, ...]  # the left one first; a single arm is called left

    # A layout belongs to one model, and is compared by identity so that it can be static under jit.
    __hash__ = object.__hash__
    __eq__ = object.__eq__

    def free_address(self, body: str) -> int:
        """Returns where the pose of a loose body begins in qpos. Raises KeyError with the names that the scene has."""
        return _find(self.free, body, "loose body")

    def mocap_index(self, body: str) -> int:
        """Returns the row of a piece of furniture in mocap_pos and mocap_quat. Raises KeyError as `free_address`."""
        return _find(self.mocap, body, "furniture")

    def joint_address(self, joint: str) -> int:
        """Returns where the value of a hinge or slide is in qpos. Raises KeyError as `free_address`."""
        return _find(self.joints, joint, "joint")


def _find(known: Mapping[str, int], name: str, kind: str) -> int:
    if name not in known:
        raise KeyError(f"no {kind} {name!r} in this scene; it has {', '.join(sorted(known)) or 'none'}")
    return known[name]


@struct.dataclass
class StateView:
    """The state of one example, read by name.

    qpos: float32 (nq,). mocap_pos: float32 (nmocap, 3). mocap_quat: float32 (nmocap, 4), MuJoCo's order wxyz.
    held: bool (A, N), which of the task's N graspables are attached to each hand.
    variation: int32 (), which variation of the task this episode is.
    """

    qpos: Array
    mocap_pos: Array
    mocap_quat: Array
    held: Array
    variation: Array
    layout: StateLayout = struct.field(pytree_node=False)

    def body_pose(self, name: str) -> Array:
        """Returns the world pose (7,), quaternion xyzw, of a body.

        name: a loose object, a piece of furniture (a mocap body), or what hangs on one of them.
        """
        if name in self.layout.mocap:
            i = self.layout.mocap[name]
            return jnp.concatenate([self.mocap_pos[i], rotations.quaternion_from_wxyz(self.mocap_quat[i])])
        if name in self.layout.links:
            return self._link_pose(self.layout.links[name])
        address = self.layout.free_address(name)
        pose = jax.lax.dynamic_slice_in_dim(self.qpos, address, 7)
        return jnp.concatenate([pose[:3], rotations.quaternion_from_wxyz(pose[3:])])

    def _link_pose(self, link: Link) -> Array:
        parent, local = self.body_pose(link.parent), jnp.asarray(link.pose, jnp.float32)
        position = point_in_world(parent, local[:3])
        turn = rotations.quaternion_multiply(parent[3:], local[3:])
        for joint in link.joints:
            axis, anchor = jnp.asarray(joint.axis, jnp.float32), jnp.asarray(joint.anchor, jnp.float32)
            value = self.qpos[joint.address] - joint.zero
            if joint.kind == SLIDE:
                position = position + rotations.quaternion_rotate(turn, axis * value)
                continue
            pivot = position + rotations.quaternion_rotate(turn, anchor)
            turn = rotations.quaternion_multiply(turn, rotations.quaternion_from_axis_angle(axis, value))
            position = pivot - rotations.quaternion_rotate(turn, anchor)
        return jnp.concatenate([position, turn])

    def joint(self, name: str) -> Array:
        """The value () of a hinge (radians) or a slide (metres)."""
        return self.qpos[self.layout.joint_address(name)]

    def tool_poses(self) -> Array:
        """The poses (A, 7) of the tool centre points."""
        return jnp.stack([forward_kinematics(self.qpos[arm.joints], jnp.asarray(arm.base)) for arm in self.layout.arms])

    def holds(self, name: str) -> Array:
        """bool (): whether any hand holds that graspable."""
        return jnp.any(self.held[:, self.layout.graspables.index(name)])

    def holds_nothing(self) -> Array:
        """bool (): whether all hands are empty."""
        return ~jnp.any(self.held)


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
    """A loose object, or a link of one, that a closing gripper attaches to within 1 cm of its box.

    The distance is that of the tool centre point.

    half_extents: metres. centre: of the box. Both in the body's frame.
    """

    body: str
    half_extents: tuple[float, float, float]
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclasses.dataclass(frozen=True)
class Attachment:
    """A loose object that rides on another body until the task releases it (`Task.release`).

    position: metres, where its origin is in the carrier's frame; its axes are the carrier's.
    """

    body: str
    carrier: str
    position: tuple[float, float, float]


@dataclasses.dataclass(frozen=True)
class TaskObject:
    """An object that the instruction names.

    phrase: what a detector looks for in a picture: one for all arms, or one for each, the left one first. A phrase that
        ends in " (one end)" or " (other end)" stands for an end of a long object instead of its centre.
    geoms: a regular expression of the whole names of the geoms that are the object.
    In both, "{words}" in braces are filled in by `Task.words`.
    """

    phrase: str | tuple[str, str]
    geoms: str


def never(view: StateView) -> Array:
    """A predicate that never holds."""
    return jnp.array(False)


@dataclasses.dataclass(frozen=True)
class Task:
    """One task. ``view`` arguments are of one example; M is the number of the expert's keyframes.

    build: adds the task's bodies to an MjSpec that has the table; names begin with the task's own words.
    sample: (PRNG key, variation int32 ()) -> Placement.
    instructions: paraphrases of the task, the plain one first; {words} in braces are filled in by ``words``.
    objects: what the instruction names, in its order: what keypoints found in pictures are of. Of several equal objects
        (blocks of one colour) one.
    recognised_by: a regular expression that recognises the task in an instruction of other words, lower case. Tasks are
        asked in the order of their names, and the first that recognises it counts.
    keypoints: view -> float32 (A, K, 3), for each arm the points to go to, in the order of the instruction. A task with
        fewer in some variations repeats the last one.
    success: view -> bool (), after every physics step.
    expert: view at reset -> Action with a leading axis M: the keyframes of a demonstration. A variation that needs
        fewer repeats the last one.
    variations: how many there are. words: variation -> what fills the braces of the instructions.
    exclusive: whether acting out one variation never succeeds at another. Not so where they differ in looks, or in a
        count of which more will do.
    stages: conditions that must have held before success counts, one after the other.
    failure: view -> bool (): once it holds, the episode has failed for good.
    graspables: what a closing gripper attaches to. targets: view -> bool (N,), which of them it is right to take;
        None: all of them.
    rests_on: body -> the body that it stands on or in, and moves with when their places are varied.
    resizable: loose bodies that may have other sizes.
    colours_matter: whether colours tell the objects apart or are named in the instructions.
    attachments: objects that ride on others. release: view -> bool (), judged after every keyframe: lets them go.
    """

    name: str
    num_arms: int
    build: Callable[[mujoco.MjSpec], None]
    sample: Callable[[Array, Array], Placement]
    instructions: tuple[str, ...]
    keypoints: Callable[[StateView], Array]
    success: Callable[[StateView], Array]
    expert: Callable[[StateView], Action]
    objects: tuple[TaskObject, ...] = ()
    recognised_by: str = ""
    variations: int = 1
    words: Callable[[int], Mapping[str, str]] = lambda variation: {}
    exclusive: bool = True
    stages: tuple[Callable[[StateView], Array], ...] = ()
    failure: Callable[[StateView], Array] = never
    graspables: tuple[Graspable, ...] = ()
    targets: Callable[[StateView], Array] | None = None
    rests_on: Mapping[str, str] = dataclasses.field(default_factory=dict)
    resizable: tuple[str, ...] = ()
    colours_matter: bool = False
    attachments: tuple[Attachment, ...] = ()
    release: Callable[[StateView], Array] = never

    def say(self, variation: int, paraphrase: int = 0) -> str:
        """Returns the instruction of a variation in one of its paraphrases (counted round)."""
        return self.instructions[paraphrase % len(self.instructions)].format(**self.words(variation))

    def all_instructions(self) -> list[str]:
        """Returns every paraphrase of every variation."""
        return [
            self.say(variation, paraphrase)
            for variation in range(self.variations)
            for paraphrase in range(len(self.instructions))
        ]

    def phrases(self, words: Mapping[str, str]) -> tuple[tuple[str, ...], ...]:
        """For each arm the phrases of the objects, in the order of the instruction; `words` fill the braces."""
        return tuple(
            tuple(
                fill(each.phrase if isinstance(each.phrase, str) else each.phrase[arm], words) for each in self.objects
            )
            for arm in range(self.num_arms)
        )


def fill(text: str, words: Mapping[str, str]) -> str:
    """The text with words in the place of their names in braces; other braces, of a regular expression, stay."""
    for name, word in words.items():
        text = text.replace(f"{{{name}}}", word)
    return text


def add_part(
    body: mujoco.MjsBody,
    name: str,
    shape: mujoco.mjtGeom,
    size: Floats,
    pos: Floats,
    rgba: Floats,
    collision: CollisionBits = VISUAL,
    /,
    **more: float | Floats,
) -> mujoco.MjsGeom:
    """Adds a geom to a body: half extents or (radius, half length) ``size``, metres. more: other fields of the geom.

    By default it is only looked at and weighs nothing; ``collision`` makes it one that collides, of ``mass`` kilograms.
    """
    size = [*size, *[0.0] * (3 - len(size))]
    if collision == VISUAL:
        more = {"mass": 0.0, **more}
    bits = {"contype": collision.contype, "conaffinity": collision.conaffinity}
    return body.add_geom(name=name, type=shape, size=size, pos=list(pos), rgba=list(rgba), **bits, **more)


def add_furniture(spec: mujoco.MjSpec, name: str) -> mujoco.MjsBody:
    """Adds a body without weight that stands where the placement puts it (a mocap body)."""
    return spec.worldbody.add_body(name=name, mocap=True, pos=[0.0, 0.0, TABLE_HEIGHT])


def add_object(spec: mujoco.MjSpec, name: str, height: float, damping: float = 0.0) -> mujoco.MjsBody:
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


def pointing_down(yaw: Array | float = 0.0) -> Array:
    """Returns the quaternion (4,) of a gripper straight down, fingers opening along the y axis of a turned body.

    yaw: the body's turn about the vertical, radians. Of the two turns half a circle apart, which grasp alike, the one
    within a quarter.
    """
    yaw = jnp.mod(jnp.asarray(yaw, jnp.float32) + jnp.pi / 2, jnp.pi) - jnp.pi / 2
    turn = rotations.quaternion_from_axis_angle(jnp.array([0.0, 0.0, 1.0]), yaw)
    return rotations.quaternion_multiply(turn, rotations.DOWN)


def leaning(angle: float, yaw: Array | float = 0.0) -> Array:
    """Returns the quaternion (4,) of a gripper that comes along the y axis of a body turned by ``yaw``.

    It points straight down at angle 0, level along +y at pi / 2 and along -y at -pi / 2. Its fingers open in the
    vertical plane through that axis.
    """
    lean = rotations.quaternion_from_axis_angle(jnp.array([1.0, 0.0, 0.0]), jnp.asarray(angle, jnp.float32))
    turn = rotations.quaternion_from_axis_angle(jnp.array([0.0, 0.0, 1.0]), jnp.asarray(yaw, jnp.float32))
    return rotations.quaternion_multiply(turn, rotations.quaternion_multiply(lean, rotations.DOWN))


def yaw_of(pose: Array) -> Array:
    """How far (), in radians, a body's pose (7,) is turned about the vertical: the heading of its x axis."""
    x, y, _ = rotations.quaternion_rotate(pose[3:], jnp.array([1.0, 0.0, 0.0]))
    return jnp.arctan2(y, x)


def point_in_world(pose: Array, point: ArrayLike | Floats) -> Array:
    """A point (3,) of a body's frame, in the world. pose (7,), point (3,) -> (3,)."""
    return pose[:3] + rotations.quaternion_rotate(pose[3:], jnp.asarray(point, jnp.float32))


def point_in_body(pose: Array, point: Array) -> Array:
    """A point (3,) of the world, in a body's frame. pose (7,), point (3,) -> (3,)."""
    return rotations.quaternion_rotate(rotations.quaternion_conjugate(pose[3:]), point - pose[:3])


def keyframes(
    positions: Iterable[ArrayLike], grippers: Sequence[float], quaternion: ArrayLike | Floats = rotations.DOWN
) -> Action:
    """The keyframes of one arm: M positions (3,) -> Action (M, 1, ...). quaternion: (4,), or (M, 4) of each."""
    points = jnp.stack([jnp.asarray(position, jnp.float32) for position in positions])
    turns = jnp.broadcast_to(jnp.asarray(quaternion, jnp.float32), (len(points), 4))
    return Action(
        pose=jnp.concatenate([points, turns], axis=-1)[:, None],
        gripper_open=jnp.asarray(grippers, jnp.float32)[:, None],
    )


def both_arms(left: Action, right: Action) -> Action:
    """The keyframes (M, 1, ...) of the left and of the right arm, executed at the same time: (M, 2, ...)."""
    return jax.tree.map(lambda *arms: jnp.concatenate(arms, axis=1), left, right)
