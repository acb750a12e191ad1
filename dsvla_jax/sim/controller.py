"""Executing a keyframe: a straight-line path, joint targets for every physics step, and attaching on grasp.

As RLBench's ``MoveArmThenGripper``: the arm goes to the pose on a straight line, then the gripper opens or closes; a
graspable between closing fingers is attached to the hand, and released before the fingers open. All functions are per
example and pure jnp; vmap them over episodes. A is the number of arms, known from ``arms``.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dsvla_jax.geometry.rotations import (
    normalize,
    quaternion_conjugate,
    quaternion_from_wxyz,
    quaternion_multiply,
    quaternion_rotate,
    quaternion_slerp,
    quaternion_to_wxyz,
)
from dsvla_jax.sim import robot
from dsvla_jax.sim.kinematics import forward_kinematics, reaches, track
from dsvla_jax.sim.robot import Arm
from dsvla_jax.types import Action, Array

WAYPOINTS = 8
WAYPOINT_ITERATIONS, LAST_ITERATIONS = 6, 20  # of inverse kinematics, each from the waypoint before
MOVE_STEPS, SETTLE_STEPS, GRIPPER_STEPS = 90, 20, 40
GRIP = MOVE_STEPS + SETTLE_STEPS  # the step at which the grippers begin to move
KEYFRAME_STEPS = GRIP + GRIPPER_STEPS
GRASP_MARGIN = 0.01  # metres around a graspable's box within which the tool centre point counts as on it
OPEN_THRESHOLD = 0.9  # RLBench: a gripper is open if its fingers are beyond 90% of their travel


def _bases(arms: Sequence[Arm]) -> Array:
    """float32 (A, 7)."""
    return jnp.asarray(np.stack([arm.base for arm in arms]))


def end_effector(qpos: Array, arms: Sequence[Arm]) -> tuple[Array, Array]:
    """qpos (nq,) -> pose float32 (A, 7) of each tool centre point, gripper_open float32 (A,), 0 or 1."""
    poses = jax.vmap(forward_kinematics)(qpos[np.stack([arm.joints for arm in arms])], _bases(arms))
    travel = jnp.mean(qpos[np.stack([arm.fingers for arm in arms])], axis=-1) / robot.FINGER_TRAVEL
    return poses, (travel > OPEN_THRESHOLD).astype(jnp.float32)


def straight_line(start: Array, end: Array) -> Array:
    """Poses (7,), (7,) -> (WAYPOINTS, 7) poses after ``start`` up to ``end``, evenly spaced in place and in turn."""
    fractions = jnp.arange(1, WAYPOINTS + 1, dtype=jnp.float32) / WAYPOINTS
    positions = start[:3] + fractions[:, None] * (end[:3] - start[:3])
    turns = jax.vmap(lambda fraction: quaternion_slerp(start[3:], end[3:], fraction))(fractions)
    return jnp.concatenate([positions, turns], axis=-1)


def plan_joints(joints: Array, pose: Array, base: Array) -> tuple[Array, Array]:
    """Joint angles (7,) now, target pose (7,), base (7,) -> knots (WAYPOINTS + 1, 7) in joint space, ok bool ().

    Only the keyframe itself must be reached; an earlier waypoint that is missed only bends the path.
    """
    end = jnp.concatenate([pose[:3], normalize(pose[3:])])
    line = straight_line(forward_kinematics(joints, base), end)
    steps = np.array([WAYPOINT_ITERATIONS] * (WAYPOINTS - 1) + [LAST_ITERATIONS])
    solutions = track(line[np.repeat(np.arange(WAYPOINTS), steps)], joints, base)
    knots = jnp.concatenate([joints[None], solutions[np.cumsum(steps) - 1]])
    return knots, reaches(knots[-1], end, base)


def _time_warp() -> tuple[np.ndarray, np.ndarray]:
    """Progress along the path and its speed per second at the end of each move step: 6t^5 - 15t^4 + 10t^3."""
    t = np.arange(1, MOVE_STEPS + 1) / MOVE_STEPS
    progress = t**3 * (10 - 15 * t + 6 * t * t)
    speed = 30 * t**2 * (1 - t) ** 2 / (MOVE_STEPS * robot.TIMESTEP)
    return progress, speed


def joint_targets(knots: Array) -> Array:
    """Knots (WAYPOINTS + 1, 7) -> position targets (MOVE_STEPS, 7) that start and end at rest.

    A position actuator's force is kp (target - q) - kv dq/dt, so it trails a moving target by kv / kp times the speed;
    that is added to the target.
    """
    progress, speed = _time_warp()
    place = progress * WAYPOINTS
    segment = np.minimum(place.astype(int), WAYPOINTS - 1)
    direction = knots[segment + 1] - knots[segment]
    positions = knots[segment] + direction * jnp.asarray(place - segment, jnp.float32)[:, None]
    velocities = direction * jnp.asarray(speed * WAYPOINTS, jnp.float32)[:, None]
    return positions + velocities * jnp.asarray(robot.VELOCITY_GAINS / robot.POSITION_GAINS, jnp.float32)


class Plan(NamedTuple):
    """One keyframe of all arms.

    controls: float32 (KEYFRAME_STEPS, nu). ok: bool (), False if a pose is out of reach, and then the controls hold
    still. opening, closing: bool (A,), the grippers that are commanded to open, and those that go from open to closed.
    """

    controls: Array
    ok: Array
    opening: Array
    closing: Array


def plan(ctrl: Array, action: Action, arms: Sequence[Arm]) -> Plan:
    """Plans one keyframe of all arms; nothing in it depends on the task.

    Args:
        ctrl: float32 (nu,), the controls in force; the path starts from the posture that they command.
        action: pose (A, 7), gripper_open (A,). arms: A arms.
    """
    commanded = ctrl[np.stack([arm.actuators for arm in arms])]  # (A, 7)
    knots, reached = jax.vmap(plan_joints)(commanded, action.pose, _bases(arms))
    ok = jnp.all(reached) & jnp.all(jnp.isfinite(action.gripper_open))
    targets = jax.vmap(joint_targets)(knots)  # (A, MOVE_STEPS, 7)

    opens = action.gripper_open > 0.5
    was_open = ctrl[np.array([arm.gripper for arm in arms])] > robot.FINGER_TRAVEL / 2
    gripper = jnp.where(opens, robot.GRIPPER_OPEN_CONTROL, robot.GRIPPER_CLOSED_CONTROL)

    controls = jnp.broadcast_to(ctrl, (KEYFRAME_STEPS, *ctrl.shape))
    for i, arm in enumerate(arms):
        controls = controls.at[:MOVE_STEPS, arm.actuators].set(targets[i])
        controls = controls.at[MOVE_STEPS:, arm.actuators].set(knots[i, -1])
        controls = controls.at[GRIP:, arm.gripper].set(gripper[i])
    return Plan(jnp.where(ok, controls, ctrl), ok, ok & opens, ok & was_open & ~opens)


def release_schedule(eq_active: Array, opening: Array, welds: np.ndarray) -> Array:
    """Which constraints hold at each step: opening grippers let go of what they hold before they open.

    eq_active bool (neq,) now, opening bool (A,), welds int (A, number of graspables) -> bool (KEYFRAME_STEPS, neq).
    """
    actives = jnp.broadcast_to(eq_active, (KEYFRAME_STEPS, *eq_active.shape))
    for opens, mine in zip(opening, welds, strict=True):
        actives = actives.at[GRIP:, mine].set(actives[GRIP:, mine] & ~opens)
    return actives


def hand_pose(tool_pose: Array) -> Array:
    """The pose (7,) of the hand's body whose tool centre point is at ``tool_pose`` (7,)."""
    tool = quaternion_from_wxyz(jnp.asarray(robot.TCP_QUATERNION_WXYZ, jnp.float32))
    turn = quaternion_multiply(tool_pose[3:], quaternion_conjugate(tool))
    offset = quaternion_rotate(turn, jnp.asarray(robot.TCP_POSITION, jnp.float32))
    return jnp.concatenate([tool_pose[:3] - offset, turn])


def weld_row(hand: Array, body: Array) -> Array:
    """Returns the eq_data (mjNEQDATA = 12,) of a weld that holds ``body`` (7,) where it is relative to ``hand`` (7,).

    It is anchor, position, quaternion wxyz, torque scale, and a zero that says that the pose is given.
    """
    inverse = quaternion_conjugate(hand[3:])
    position = quaternion_rotate(inverse, body[:3] - hand[:3])
    turn = quaternion_to_wxyz(quaternion_multiply(inverse, body[3:]))
    return jnp.concatenate([jnp.zeros(3), position, turn, jnp.ones(1), jnp.zeros(1)]).astype(jnp.float32)


def attach(
    eq_active: Array,
    eq_data: Array,
    tool_poses: Array,
    closing: Array,
    body_poses: Array,
    half_extents: np.ndarray,
    centres: np.ndarray,
    welds: np.ndarray,
) -> tuple[Array, Array]:
    """Welds to each hand that has just closed the graspable whose box is at the tool centre point, the closest if more.

    Args:
        eq_active: bool (neq,). eq_data: float32 (neq, mjNEQDATA).
        tool_poses: float32 (A, 7). closing: bool (A,).
        body_poses: float32 (N, 7). half_extents, centres: (N, 3), the graspables' boxes in their bodies' frames.
        welds: int (A, N).

    Returns:
        the new eq_active and eq_data.
    """
    if not welds.size:
        return eq_active, eq_data

    def outside(tool: Array, body: Array, half: Array, centre: Array) -> Array:
        local = quaternion_rotate(quaternion_conjugate(body[3:]), tool[:3] - body[:3])
        return jnp.max(jnp.abs(local - centre) - half)

    for i in range(welds.shape[0]):
        distances = jax.vmap(outside, in_axes=(None, 0, 0, 0))(
            tool_poses[i], body_poses, jnp.asarray(half_extents, jnp.float32), jnp.asarray(centres, jnp.float32)
        )
        grasped = closing[i] & (distances < GRASP_MARGIN) & (jnp.arange(len(half_extents)) == jnp.argmin(distances))
        hand = hand_pose(tool_poses[i])
        rows = jax.vmap(weld_row, in_axes=(None, 0))(hand, body_poses)
        eq_data = eq_data.at[welds[i]].set(jnp.where(grasped[:, None], rows, eq_data[welds[i]]))
        eq_active = eq_active.at[welds[i]].set(eq_active[welds[i]] | grasped)
    return eq_active, eq_data
