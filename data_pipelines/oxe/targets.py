"""What the policy is to answer at each frame of an episode: the pose or displacement some time ahead."""

import dataclasses

import numpy as np
from scipy.spatial.transform import Rotation

from data_pipelines.oxe.dataset import OxeDataset
from data_pipelines.oxe.motion import Motion
from dsvla_jax.data_config import OxeConfig
from dsvla_jax.encoding.displacement import LEAST_RANGE, displacement
from dsvla_jax.errors import UserError

# A pose that says nothing: the middle of the codec's box, no rotation. Stands for poses that a dataset does not tell.
UNKNOWN_POSE = np.array([0, 0, 1, 0, 0, 0, 1], np.float32)
STILL_FRACTION = 0.05
"""Of the episode's largest step: a hand that moves less stands still."""


@dataclasses.dataclass(frozen=True)
class Targets:
    """The samples of one episode. Axis F: frames that have a target.

    frame: int (F,), number among the steps that are used. pose: (F, A, 7) present. gripper_open: (F, A) present.
    target_pose: (F, A, 7), or None for relative targets. displacement: (F, A, 6), or None for absolute ones.
    target_gripper: (F, A). float32.
    """

    frame: np.ndarray
    pose: np.ndarray
    gripper_open: np.ndarray
    target_pose: np.ndarray | None
    displacement: np.ndarray | None
    target_gripper: np.ndarray


def why_unsupported(dataset: OxeDataset, config: OxeConfig) -> str | None:
    """Why a dataset cannot give the targets that are asked for, or None."""
    if dataset.encoding == "navigation":
        return "it is navigation, without a hand"
    if dataset.has_pose:
        return None
    if dataset.encoding == "joints":
        return "it tells joints, not the hand"
    return "it tells no poses of the hand, only displacements" if config.target == "absolute" else None


def make_targets(motion: Motion, dataset: OxeDataset, config: OxeConfig) -> Targets:
    """Returns the targets of an episode of T steps: one for every step but the last.

    If the dataset's actions are keyframes, every step has a target, its own action, whatever the horizon. Otherwise,
    with a horizon, the target of step t is step t + horizon, or the last one; with keyframes, the next keyframe. Its
    displacement is that between reached poses if the dataset records poses, else the composition of the commands in
    between. The target's gripper is the command that holds there (of the last but one step at the end, where the last
    step's command was never carried out).
    """
    if reason := why_unsupported(dataset, config):
        raise UserError(f"{dataset.name}: cannot give {config.target} targets: {reason}; leave it out of the mixture")
    steps = motion.num_steps
    if motion.keyframe is not None and motion.pose is not None:
        relative = config.target == "relative"
        return Targets(
            frame=np.arange(steps),
            pose=motion.pose,
            gripper_open=motion.gripper_open,
            target_pose=None if relative else motion.keyframe,
            displacement=displacement(motion.pose, motion.keyframe).astype(np.float32) if relative else None,
            target_gripper=motion.gripper_command,
        )
    frame = np.arange(max(steps - 1, 0))
    if config.horizon > 0:
        ahead = max(1, round(config.horizon * dataset.hz / dataset.stride))
        end = np.minimum(frame + ahead, steps - 1)
    else:
        keys = np.array(keyframes(motion), int)
        end = keys[np.searchsorted(keys, frame, side="right")]
    unknown = np.broadcast_to(UNKNOWN_POSE, (steps, motion.num_arms, 7))
    present = unknown if motion.pose is None else motion.pose
    moved = None
    if config.target == "relative":
        moved = (
            _between(motion, frame, end, dataset.frame)
            if motion.pose is None
            else displacement(present[frame], present[end])
        )
        moved = moved.astype(np.float32)
    return Targets(
        frame=frame,
        pose=present[frame],
        gripper_open=motion.gripper_open[frame],
        target_pose=present[end] if config.target == "absolute" else None,
        displacement=moved,
        target_gripper=motion.gripper_command[np.minimum(end, max(steps - 2, 0))],
    )


def keyframes(motion: Motion) -> list[int]:
    """Steps (ascending, the last one always among them) at which a gripper's command changes or all hands come to rest.

    After a rest the next four steps are no other, as in PerAct's keyframes.
    """
    steps = motion.num_steps
    moves = _speeds(motion)
    # A hand that only trembles does not rest now and then: it stands still throughout.
    still = moves < max(STILL_FRACTION * float(moves.max(initial=0.0)), LEAST_RANGE)
    changed = np.zeros(steps, bool)
    changed[1:] = np.any((motion.gripper_command[1:] > 0.5) != (motion.gripper_command[:-1] > 0.5), axis=1)
    found, pause = [], 0
    for step in range(1, steps):
        rests = pause == 0 and still[step] and not still[step - 1] and step < steps - 2
        pause = 4 if rests else max(pause - 1, 0)
        if rests or changed[step] or step == steps - 1:
            found.append(step)
    return found or [0]


def _speeds(motion: Motion) -> np.ndarray:
    """(T,): how far the hands move in a step, metres and radians added up."""
    if motion.pose is not None:
        moved = displacement(motion.pose[:-1], motion.pose[1:])
        moved = np.concatenate([moved, np.zeros((1, *moved.shape[1:]))])
    elif motion.action is not None:
        moved = motion.action
    else:
        return np.ones(motion.num_steps)
    return np.linalg.norm(moved, axis=-1).sum(axis=-1)


def _between(motion: Motion, start: np.ndarray, end: np.ndarray, frame: str) -> np.ndarray:
    """(F, A, 6): commands from `start` up to `end` composed; those in the tool's frame turn with it."""
    assert motion.action is not None
    steps, arms = motion.action.shape[:2]
    result = np.zeros((len(start), arms, 6))
    for arm in range(arms):
        # Poses that the commands would lead through, from an arbitrary start.
        turns = Rotation.from_rotvec(motion.action[:, arm, 3:])
        rotations = [Rotation.identity()]
        positions = [np.zeros(3)]
        for step in range(steps - 1):
            moved = motion.action[step, arm, :3].astype(np.float64)
            positions.append(positions[-1] + (rotations[-1].apply(moved) if frame == "tool" else moved))
            rotations.append(rotations[-1] * turns[step] if frame == "tool" else turns[step] * rotations[-1])
        passed = np.stack(positions)
        quaternions = Rotation.concatenate(rotations).as_quat()
        first, last = Rotation.from_quat(quaternions[start]), Rotation.from_quat(quaternions[end])
        if frame == "tool":
            result[:, arm, :3] = first.inv().apply(passed[end] - passed[start])
            result[:, arm, 3:] = (first.inv() * last).as_rotvec()
        else:
            result[:, arm, :3] = passed[end] - passed[start]
            result[:, arm, 3:] = (last * first.inv()).as_rotvec()
    return result
