"""Which frames of a demonstration are its keyframes: PerAct's heuristic, exactly.

Sources: ``helpers/demo_loading_utils.py`` and ``agents/peract_bc/launch_utils.py`` of peract/peract, and the former of
markusgrotz/peract_bimanual for two arms.
"""

import numpy as np

from dsvla_jax.errors import DataError

# Radians per second: the largest joint velocity of a robot that stands still.
STILL = 0.1
# Frames after a stop in which no further stop counts.
STOP_BUFFER = 4
# Radians per second: half of the time no joint of a table-top arm moves faster, so larger numbers are degrees.
MAX_MIDDLE_SPEED = 4.0


def check_velocities(joint_velocities: np.ndarray, where: object) -> None:
    """Raises DataError if velocities (T, A, J) are not finite, or cannot be radians per second."""
    if not np.isfinite(joint_velocities).all():
        raise DataError(where, "joint_velocities", "finite numbers", "non-finite ones", "leave such observations out")
    middle = float(np.median(np.abs(joint_velocities).max(axis=(1, 2))))
    if middle > MAX_MIDDLE_SPEED:
        got = f"{middle:.3g} for the fastest joint, half of the time"
        fix = "divide degrees per second by 57.3; in those no rest would be found"
        raise DataError(where, "joint_velocities", "radians per second", got, fix)


def ever_rests(joint_velocities: np.ndarray, still: float = STILL) -> bool:
    """Whether all joints stand still at once at any time of velocities (T, A, J)."""
    return bool(np.any(np.all(np.abs(joint_velocities) <= still, axis=(1, 2))))


def discover_keyframes(
    gripper_open: np.ndarray, joint_velocities: np.ndarray, still: float = STILL, stop_buffer: int = STOP_BUFFER
) -> list[int]:
    """Frames at which a gripper has changed, all arms stand still, or the demonstration ends.

    A frame counts as a stop when all joints of all arms are still, it is not one of the last two frames, no gripper
    changes from two frames before it to one frame after, and the last stop was more than `stop_buffer` frames ago.
    Frame 0 is never a keyframe; of two adjacent ones at the end the first is dropped.

    Looking back from frames 0 and 1 wraps to the end of the demonstration, as Python's negative indices do in PerAct.
    So a robot that stands still at the start uses up a stop on frame 0, unless its grippers end in another state than
    they start in; then frame 1 or 2 may become a keyframe.

    Args:
        gripper_open: float (T, A), compared for equality. joint_velocities: float (T, A, J), radians per second.

    Returns:
        ascending frame numbers; the last one is T - 1. Empty for T < 2.
    """
    count = len(gripper_open)
    keyframes: list[int] = []
    buffer = 0
    for i in range(count):
        # i - 1 and i - 2 may be negative: see above.
        stopped = (
            buffer <= 0
            and i < count - 2
            and bool(np.all(np.abs(joint_velocities[i]) <= still))
            and all(np.array_equal(gripper_open[i], gripper_open[j]) for j in (i + 1, i - 1, i - 2))
        )
        buffer = stop_buffer if stopped else buffer - 1
        changed = i > 0 and not np.array_equal(gripper_open[i], gripper_open[i - 1])
        if i > 0 and (changed or stopped or i == count - 1):
            keyframes.append(i)
    if len(keyframes) > 1 and keyframes[-1] - 1 == keyframes[-2]:
        del keyframes[-2]
    return keyframes


def sample_starts(keyframes: list[int], every_n: int) -> list[tuple[int, int]]:
    """(frame to look at, keyframe to go to) for every sample of a demonstration, in order, each frame once.

    Frames: the first, every keyframe but the last, and, with every_n > 0, every `every_n`-th before the last. Each
    goes to the next keyframe. PerAct adds the keyframes again for each of the latter; here an epoch has them once.
    """
    if not keyframes:
        return []
    last = keyframes[-1]
    starts = {0, *keyframes[:-1], *(range(0, last, every_n) if every_n > 0 else ())}
    return [(start, min(k for k in keyframes if k > start)) for start in sorted(starts)]
