"""Forward and inverse kinematics of the Panda, per example in float32; vmap for batches.

The chain is ``robot.py``'s. Poses are [x, y, z, qx, qy, qz, qw] of the tool centre point in the world frame.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dsvla_jax.geometry.rotations import (
    matrix_to_quaternion,
    quaternion_conjugate,
    quaternion_multiply,
    quaternion_to_matrix,
    quaternion_to_rotation_vector,
)
from dsvla_jax.sim import robot
from dsvla_jax.types import Array

POSITION_TOLERANCE = 0.002  # metres
ROTATION_TOLERANCE = 0.02  # radians

# A posture in the middle of the table's workspace; joints that the pose leaves free drift towards it.
REST_JOINTS = np.array([0.0, 0.1, 0.0, -2.0, 0.0, 2.1, 0.785], np.float32)
_JOINT_LOW = (robot.JOINT_LOW + 0.005).astype(np.float32)
_JOINT_HIGH = (robot.JOINT_HIGH - 0.005).astype(np.float32)


def _rotation_from_wxyz(quaternion: np.ndarray) -> np.ndarray:
    """(..., 4) of any length -> float64 (..., 3, 3)."""
    return quaternion_to_matrix(np.roll(quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True), -1, axis=-1))


# Rounded, as quarter turns are exactly that.
_LINK_ROTATIONS = _rotation_from_wxyz(robot.LINK_QUATERNIONS_WXYZ).round(12)
# The hand and the tool centre point are rigid behind the last joint: one transform.
_TOOL_ROTATION = (_LINK_ROTATIONS[7] @ _rotation_from_wxyz(robot.TCP_QUATERNION_WXYZ)).round(12)
_TOOL_POSITION = robot.LINK_POSITIONS[7] + _LINK_ROTATIONS[7] @ robot.TCP_POSITION


class Chain(NamedTuple):
    """The arm at one posture, in the world.

    axes, origins: float32 (7, 3), of the joints. rotation: (3, 3), position: (3,), of the tool centre point.
    """

    axes: Array
    origins: Array
    rotation: Array
    position: Array


def _combine(columns: Sequence[Array], weights: np.ndarray) -> Array:
    """The sum of three vectors times constants (3,), or 0 if all of these are.

    Written out because most are 0 or 1, and because products of 3x3 matrices one by one cost a CPU more in calls than
    in arithmetic.
    """
    terms = [column if w == 1 else column * np.float32(w) for column, w in zip(columns, weights, strict=True) if w]
    return sum(terms, start=jnp.float32(0))


def _chain(joints: Array, base: Array) -> Chain:
    matrix, position = quaternion_to_matrix(base[3:]), base[:3]
    columns = (matrix[:, 0], matrix[:, 1], matrix[:, 2])
    axes, origins = [], []
    cosines, sines = jnp.cos(joints), jnp.sin(joints)
    for i in range(7):
        position = position + _combine(columns, robot.LINK_POSITIONS[i])
        x, y, z = (_combine(columns, weights) for weights in _LINK_ROTATIONS[i].T)
        axes.append(z)
        origins.append(position)
        c, s = cosines[i], sines[i]
        columns = (c * x + s * y, c * y - s * x, z)
    position = position + _combine(columns, _TOOL_POSITION)
    rotation = jnp.stack([_combine(columns, weights) for weights in _TOOL_ROTATION.T], axis=1)
    return Chain(jnp.stack(axes), jnp.stack(origins), rotation, position)


def forward_kinematics(joints: Array, base: Array) -> Array:
    """Joint angles (7,) of an arm whose base has the pose ``base`` (7,) -> pose (7,) of the tool centre point."""
    chain = _chain(joints, base)
    return jnp.concatenate([chain.position, matrix_to_quaternion(chain.rotation)])


def _pose_error(chain: Chain, target: Array) -> Array:
    """(6,) translation in metres and rotation vector in radians that would bring the tool to the target pose."""
    difference = quaternion_multiply(target[3:], quaternion_conjugate(matrix_to_quaternion(chain.rotation)))
    return jnp.concatenate([target[:3] - chain.position, quaternion_to_rotation_vector(difference)])


def _solve_spd(matrix: Array, right: Array) -> Array:
    """Solves a small symmetric positive definite system, matrix (n, n), right (n,), by unrolled Gauss-Jordan steps.

    Batches of such small systems are slow through LAPACK on a CPU and through general solvers on accelerators.
    """
    rows = jnp.concatenate([matrix, right[:, None]], axis=1)
    for i, unit in enumerate(np.eye(len(right), dtype=np.float32)):
        rows = rows - jnp.outer(rows[:, i] - unit, rows[i] / rows[i, i])
    return rows[:, -1]


def track(targets: Array, seed: Array, base: Array) -> Array:
    """One step of inverse kinematics towards each of the target poses in turn.

    Damped least squares with the damping tied to the error (Sugihara 2011, "Solvability-unconcerned inverse
    kinematics by the Levenberg-Marquardt method"), a step in the null space towards ``REST_JOINTS``, and the joint
    limits as a clip after each step.

    Args:
        targets: float32 (M, 7), unit quaternions. seed: float32 (7,) joint angles.
        base: float32 (7,) pose of the arm's base in the world.

    Returns:
        float32 (M, 7) joint angles after each step, within the limits.
    """

    def step(joints: Array, target: Array) -> tuple[Array, Array]:
        chain = _chain(joints, base)
        error = _pose_error(chain, target)
        # A far target is approached in bounded steps: the linearisation holds only nearby.
        error = error * jnp.minimum(1.0, 0.5 / jnp.maximum(jnp.linalg.norm(error), 1e-9))
        linear = jnp.cross(chain.axes, chain.position - chain.origins)
        jacobian = jnp.concatenate([linear, chain.axes], axis=1).T  # (6, 7)
        damping = 0.02 * jnp.sum(error**2) + 1e-5
        gram = jacobian @ jacobian.T + damping * jnp.eye(6, dtype=jnp.float32)
        rest = 0.1 * (REST_JOINTS - joints)
        change = rest + jacobian.T @ _solve_spd(gram, error - jacobian @ rest)
        change = change * jnp.minimum(1.0, 1.0 / jnp.maximum(jnp.max(jnp.abs(change)), 1e-9))
        joints = jnp.clip(joints + change, _JOINT_LOW, _JOINT_HIGH)
        return joints, joints

    # Accelerators would otherwise multiply float32 matrices in fewer bits than the tolerances bear.
    with jax.default_matmul_precision("highest"):
        return jax.lax.scan(step, jnp.asarray(seed, jnp.float32), targets)[1]


def reaches(joints: Array, pose: Array, base: Array) -> Array:
    """bool (): whether the joints (7,) hold the tool centre point within 2 mm and 0.02 rad of ``pose`` (7,)."""
    error = _pose_error(_chain(joints, base), pose)
    return (jnp.linalg.norm(error[:3]) < POSITION_TOLERANCE) & (jnp.linalg.norm(error[3:]) < ROTATION_TOLERANCE)
