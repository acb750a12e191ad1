"""Known motions for fixtures: what a robot did at each step, in the conventions that datasets write it in."""

import dataclasses
from functools import cached_property
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

Kind = Literal["full", "still", "planar", "yaw", "navigation"]
"""still: no rotation. planar: no rotation, height 0. yaw: turns about z only. navigation: yaw at height 0."""

INSTRUCTIONS = ("turn on the light", "close the fridge", "put rubbish in bin", "lift the ball")


@dataclasses.dataclass(frozen=True)
class KnownArm:
    """position: (T, 3) metres. rotation: T rotations. open: (T,), commanded, 0 or 1. was: (T,), one step later."""

    position: np.ndarray
    rotation: Rotation
    open: np.ndarray

    @property
    def was(self) -> np.ndarray:
        return np.concatenate([self.open[:1], self.open[:-1]])

    @property
    def pose(self) -> np.ndarray:
        """(T, 7), quaternions xyzw."""
        return np.concatenate([self.position, self.rotation.as_quat(canonical=True)], axis=1)


@dataclasses.dataclass(frozen=True)
class KnownEpisode:
    """A whole known episode."""

    arms: tuple[KnownArm, ...]
    instruction: str
    seed: int

    @property
    def num_steps(self) -> int:
        return len(self.arms[0].open)

    def colour(self, step: int) -> tuple[int, int, int]:
        """Of every picture at a step, red first."""
        return (40 + 20 * (self.seed % 5), 60 + 12 * (step % 12), 200)


def known_episode(kind: Kind, arms: int, steps: int, seed: int) -> KnownEpisode:
    """A smooth random motion inside a table's workspace; the gripper closes half-way and opens before the end."""
    rng = np.random.default_rng(seed)
    made = []
    for arm in range(arms):
        moves = rng.uniform(-0.03, 0.03, (steps, 3))
        moves[:, 2] *= 0.5
        position = np.array([0.4, 0.2 * (1 - 2 * arm), 0.4]) + np.cumsum(moves, axis=0)
        turns = Rotation.from_rotvec(rng.uniform(-0.1, 0.1, (steps, 3)))
        start = Rotation.from_rotvec(rng.uniform(-0.6, 0.6, 3))
        if kind in ("still", "planar"):
            turns, start = Rotation.from_rotvec(np.zeros((steps, 3))), Rotation.identity()
        if kind in ("yaw", "navigation"):
            turns, start = Rotation.from_euler("z", rng.uniform(-0.1, 0.1, (steps, 1))), Rotation.identity()
        if kind in ("planar", "navigation"):
            position[:, 2] = 0.0
        rotations = [start]
        for turn in list(turns)[1:]:
            rotations.append(turn * rotations[-1])
        command = np.ones(steps)
        command[steps // 2 : max(steps - 2, steps // 2 + 1)] = 0.0
        made.append(KnownArm(position, Rotation.concatenate(rotations), command))
    return KnownEpisode(tuple(made), INSTRUCTIONS[seed % len(INSTRUCTIONS)], seed)


class StepOf:
    """One arm at one step, in every convention that a dataset of the registry writes.

    p, dp: position and displacement to the next step (zero at the last). xyzw, wxyz, rpy, ypr, zxy, rotvec, matrix: the
    rotation; d before the name: that to the next step; next: that of the next step. open, was: commanded and measured.
    closing: 1, -1 or 0.
    """

    def __init__(self, arm: KnownArm, step: int, rng: np.random.Generator):
        self._rng = rng
        following = min(step + 1, len(arm.open) - 1)
        self.p, self.dp = arm.position[step], arm.position[following] - arm.position[step]
        self._rotation = arm.rotation[step]
        self._turn = arm.rotation[following] * arm.rotation[step].inv()
        self._tool_turn = arm.rotation[step].inv() * arm.rotation[following]
        self.tool_dp = arm.rotation[step].inv().apply(self.dp)
        self.open, self.was = float(arm.open[step]), float(arm.was[step])
        before = self.open if step == 0 else float(arm.open[step - 1])
        self.closing = before - self.open
        self.next_was = float(arm.was[following])
        self.next_p, self.next_rotvec = arm.position[following], arm.rotation[following].as_rotvec()
        self.next_wxyz = np.roll(arm.rotation[following].as_quat(), 1)

    def noise(self, size: int) -> np.ndarray:
        """Columns that must not be read."""
        return self._rng.normal(3.0, 1.0, size)

    xyzw = property(lambda self: self._rotation.as_quat())
    wxyz = property(lambda self: np.roll(self._rotation.as_quat(), 1))
    rpy = property(lambda self: self._rotation.as_euler("xyz"))
    ypr = property(lambda self: self._rotation.as_euler("ZYX"))
    zxy = property(lambda self: self._rotation.as_euler("zxy"))
    rotvec = property(lambda self: self._rotation.as_rotvec())
    drpy = property(lambda self: self._turn.as_euler("xyz"))
    drotvec = property(lambda self: self._turn.as_rotvec())
    dxyzw = property(lambda self: self._turn.as_quat())
    tool_drpy = property(lambda self: self._tool_turn.as_euler("xyz"))
    tool_drotvec = property(lambda self: self._tool_turn.as_rotvec())
    tool_dypr = property(lambda self: self._tool_turn.as_euler("ZYX"))
    yaw = property(lambda self: self._rotation.as_euler("xyz")[2:])
    dyaw = property(lambda self: self._turn.as_euler("xyz")[2:])

    @cached_property
    def matrix(self) -> np.ndarray:
        """(4, 4)."""
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = self._rotation.as_matrix(), self.p
        return matrix
