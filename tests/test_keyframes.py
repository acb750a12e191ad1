"""Keyframes of recorded demonstrations: PerAct's rule, restated apart from the project's own."""

import random

import numpy as np
import pytest

from data_pipelines.keyframes import discover_keyframes, sample_starts


def restated_keyframes(gripper, still):
    """PerAct's rule as its authors' documentation and code word it, for lists of one arm: gripper[i], still[i]."""
    count, frames, wait = len(gripper), [], 0
    for i in range(count):
        unchanged = i < count - 2 and gripper[i] == gripper[i + 1] and gripper[i] == gripper[i - 1]
        unchanged = unchanged and gripper[i - 2] == gripper[i - 1]
        stop = wait <= 0 and still[i] and i != count - 2 and unchanged
        if stop:
            wait = 4
        else:
            wait -= 1
        if i == 0:
            continue
        if gripper[i] != gripper[i - 1] or i == count - 1 or stop:
            frames.append(i)
    if len(frames) >= 2 and frames[-2] == frames[-1] - 1:
        frames.pop(len(frames) - 2)
    return frames


def keyframes(gripper, still):
    """`discover_keyframes` for strings: o open, x closed; . still, m moving."""
    opened = np.array([[letter == "o"] for letter in gripper], float)
    velocity = np.array([[[0.0, -0.1] if letter == "." else [0.0, -0.1001]] for letter in still])
    found = discover_keyframes(opened, velocity)
    assert found == restated_keyframes(gripper, [letter == "." for letter in still])
    return found


@pytest.mark.parametrize(
    ("gripper", "still", "expected"),
    [
        ("oooooooooo", "mmmmmmmmmm", [9]),  # only the end
        ("ooooxxxxxx", "mmmmmmmmmm", [4, 9]),  # the first frame in which the gripper has changed
        ("ooooxxxxxo", "mmmmmmmmmm", [4, 9]),  # a change at the end is the end
        ("ooooooooox", "mmmmmmmmmm", [9]),
        ("oooooooxox", "mmmmmmmmmm", [7, 9]),  # of 8 and 9 the end stays
        ("oooooooxxo", "mmmmmmmm..", [7, 9]),  # no stop in the last two frames
        ("oooooooooo", "mmmm.mmmmm", [4, 9]),
        ("oooooooooooooo", "mmm..........m", [3, 8, 13]),  # a stop, and 4 frames later at the earliest the next one
        ("oooooooooo", "mmmmmmm.mm", [7, 9]),
        ("oooooooooo", "mmmmmmmm.m", [9]),  # the last but one never stops
        ("oooxxxxxxx", "mm...mmmmm", [3, 9]),  # still around a change, which is no stop
        ("oooxxxxxxx", "mm....mmmm", [3, 5, 9]),  # still from 2 on, but a stop only once the gripper rests
        ("oo", "..", [1]),
        ("ooo", "...", [2]),
        ("o", ".", []),
    ],
)
def test_keyframes_are_peracts(gripper, still, expected):
    assert keyframes(gripper, still) == expected


def test_looking_back_from_the_start_wraps_to_the_end():
    # The gripper ends as it starts, so frame 0 is a stop by what frames -1 and -2 hold, and uses the buffer up.
    assert keyframes("oooooooooo", "....mmmmmm") == [9]
    assert keyframes("oooooooooo", "......mmmm") == [5, 9]
    # It ends in another state: no stop at 0 and 1, so 2 is one.
    assert keyframes("oooooooxxx", "....mmmmmm") == [2, 7, 9]
    # Only the last but one differs: frame 0 looks at it, frame 1 does not.
    assert keyframes("oooooooxxo", "....mmmmmm") == [1, 7, 9]


def test_keyframes_of_random_demonstrations_are_peracts():
    rng = random.Random(0)
    for _ in range(500):
        count = rng.randint(1, 40)
        gripper, still = [rng.choice("oox")], [rng.choice(".m")]
        for _ in range(count - 1):
            gripper.append(rng.choice(gripper[-1] * 9 + "ox"))
            still.append(rng.choice(still[-1] * 4 + ".m"))
        keyframes("".join(gripper), "".join(still))


def test_two_arms_stop_together_and_change_alone():
    gripper = np.ones((20, 2))
    gripper[12:, 1] = 0
    velocity = np.ones((20, 2, 7))
    velocity[3:6, 0] = 0  # one arm waits
    velocity[8, :] = 0  # both do
    assert discover_keyframes(gripper, velocity) == [8, 12, 19]


def test_samples_start_at_keyframes_and_every_nth_frame():
    assert sample_starts([7, 12, 25], 0) == [(0, 7), (7, 12), (12, 25)]
    assert sample_starts([7, 12, 25], 10) == [(0, 7), (7, 12), (10, 12), (12, 25), (20, 25)]
    assert sample_starts([], 10) == []
