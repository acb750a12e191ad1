"""Standardised motions as statistics, and drawn over time, one panel a quantity and arm."""

from collections.abc import Sequence

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from data_pipelines.inspect.page import Table
from data_pipelines.oxe.motion import Motion
from dsvla_jax.encoding.displacement import LEAST_RANGE, displacement

COMPONENTS = ("x (m)", "y (m)", "z (m)", "rx (rad)", "ry (rad)", "rz (rad)")
STATISTICS = ("quantity", "mean", "deviation", "least", "1 %", "median", "99 %", "most")

WIDTH, PANEL, LEFT, RIGHT = 560, 96, 74, 46
_GROUND, _GRID, _TEXT = (24, 24, 24), (70, 70, 70), (200, 200, 200)
_COLOURS = ((255, 90, 90), (90, 220, 90), (110, 150, 255))
_GRIPPER = ((255, 200, 60), (160, 160, 160))
_SIDES = {1: ("",), 2: ("left ", "right ")}

_Panel = tuple[str, np.ndarray, Sequence[str], Sequence[tuple[int, int, int]]]


def motion_statistics(motions: Sequence[Motion]) -> Table:
    """Of state and action, arm by arm."""
    rows = []
    for arm in range(motions[0].num_arms):
        poses = [motion.pose[:, arm] for motion in motions if motion.pose is not None]
        actions = [motion.action[:, arm] for motion in motions if motion.action is not None]
        joints = [motion.joints[:, arm] for motion in motions if motion.joints is not None]
        values: dict[str, list[np.ndarray]] = {}
        if poses:
            names = ("x (m)", "y (m)", "z (m)", "qx", "qy", "qz", "qw")
            reached = [displacement(pose[:-1], pose[1:]) for pose in poses]
            values |= {f"pose {name}": [pose[:, i] for pose in poses] for i, name in enumerate(names)}
            values["reached step (m)"] = [np.linalg.norm(moved[:, :3], axis=1) for moved in reached]
            values["reached turn a step (rad)"] = [np.linalg.norm(moved[:, 3:], axis=1) for moved in reached]
        if actions:
            values |= {f"action {name}": [action[:, i] for action in actions] for i, name in enumerate(COMPONENTS)}
            values["commanded step (m)"] = [np.linalg.norm(action[:, :3], axis=1) for action in actions]
            values["commanded turn a step (rad)"] = [np.linalg.norm(action[:, 3:], axis=1) for action in actions]
        if joints:
            values |= {f"joint {i}": [rows[:, i] for rows in joints] for i in range(joints[0].shape[1])}
        values["gripper is open"] = [motion.gripper_open[:, arm] for motion in motions]
        values["gripper told to be open"] = [motion.gripper_command[:, arm] for motion in motions]
        side = _SIDES[motions[0].num_arms][arm]
        rows += [statistics_row(f"{side}{name}", np.concatenate(columns)) for name, columns in values.items()]
    return Table(f"standardised state and action, of {len(motions)} episodes", STATISTICS, rows)


def statistics_row(name: str, values: np.ndarray) -> tuple[str, ...]:
    """One row under `STATISTICS` of values (N,)."""
    if not len(values):
        return (name, *("" for _ in STATISTICS[1:]))
    low, median, high = np.quantile(values, [0.01, 0.5, 0.99])
    numbers = (values.mean(), values.std(), values.min(), low, median, high, values.max())
    return (name, *(f"{number:.3g}" for number in numbers))


def draw_motion(motion: Motion) -> np.ndarray:
    """uint8 (PANEL x panels, WIDTH, 3): what the robot did and was commanded to do, over the steps that are used."""
    panels = [panel for arm in range(motion.num_arms) for panel in _panels(motion, arm)]
    return np.concatenate([_draw_panel(*panel) for panel in panels])


def turns(pose: np.ndarray) -> np.ndarray:
    """(T, 3) of poses (T, 7): the rotation vector since the first step, radians."""
    rotations = Rotation.from_quat(pose[:, 3:])
    return (rotations * rotations[0].inv()).as_rotvec()


def _panels(motion: Motion, arm: int) -> list[_Panel]:
    side = _SIDES[motion.num_arms][arm]
    panels: list[_Panel] = []
    if motion.pose is not None:
        pose = motion.pose[:, arm]
        panels.append((f"{side}position, m", pose[:, :3], "xyz", _COLOURS))
        panels.append((f"{side}turn since the start, rad", turns(pose), "xyz", _COLOURS))
    if motion.action is not None:
        panels.append((f"{side}commanded step, m", motion.action[:, arm, :3], "xyz", _COLOURS))
        panels.append((f"{side}commanded turn a step, rad", motion.action[:, arm, 3:], "xyz", _COLOURS))
    gripper = np.stack([motion.gripper_command[:, arm], motion.gripper_open[:, arm]], axis=1)
    panels.append((f"{side}gripper, 1 is open", gripper, ("command", "is"), _GRIPPER))
    return panels


def _draw_panel(
    title: str, values: np.ndarray, names: Sequence[str], colours: Sequence[tuple[int, int, int]]
) -> np.ndarray:
    """values: (T, n), a curve a column."""
    picture = np.full((PANEL, WIDTH, 3), _GROUND, np.uint8)
    low, high = float(values.min()), float(values.max())
    # A constant is a line in the middle.
    middle, half = (low + high) / 2, max((high - low) / 2, LEAST_RANGE)
    top, bottom = 24, PANEL - 8
    x = np.linspace(LEFT, WIDTH - RIGHT, len(values)) if len(values) > 1 else np.array([LEFT], float)
    for level in (low, high):
        y = round((top + bottom) / 2 - (level - middle) / half * (bottom - top) / 2)
        cv2.line(picture, (LEFT, y), (WIDTH - RIGHT, y), _GRID, 1)
        _write(picture, f"{level:.3g}", (6, y + 4), _TEXT)
    for number, (name, colour) in enumerate(zip(names, colours, strict=False)):
        y = (top + bottom) / 2 - (values[:, number] - middle) / half * (bottom - top) / 2
        points = np.rint(np.stack([x, y], axis=1) * 8).astype(np.int32)
        cv2.polylines(picture, [points], False, colour, 1, cv2.LINE_AA, shift=3)
        _write(picture, name, (WIDTH - RIGHT + 8, 34 + 18 * number), colour)
    _write(picture, title, (LEFT, 14), _TEXT)
    return picture


def _write(picture: np.ndarray, text: str, place: tuple[int, int], colour: tuple[int, int, int]) -> None:
    cv2.putText(picture, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.4, colour, 1, cv2.LINE_AA)
