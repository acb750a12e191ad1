"""A policy that is denied a part of what it looks at."""

import dataclasses
import json

import jax
import numpy as np
import pytest

from data_pipelines.records import decode_frame
from dsvla_jax.errors import UserError
from dsvla_jax.evaluation.conditions import Conditions, conditions_from_json
from dsvla_jax.evaluation.withheld import PARTS, check_parts, withholding
from dsvla_jax.types import Action, Observation
from tests.random_data import random_episode

FRAMES = [decode_frame(random_episode(seed), 0) for seed in range(4)]
SEEN = jax.tree.map(lambda *x: np.stack(x), *[Observation(frame.pictures, frame.robot) for frame in FRAMES])
KEYPOINTS = np.stack([frame.keypoint for frame in FRAMES])


def what_it_gets(*parts: str) -> tuple[Observation, np.ndarray | None]:
    got: list[tuple[Observation, np.ndarray | None]] = []

    def act(observation, instructions, keypoints):
        got.append((observation, keypoints))
        return Action(observation.robot.pose, observation.robot.gripper_open), instructions

    withholding(act, check_parts(parts))(SEEN, ["do it"] * 4, KEYPOINTS)
    return got[0]


def test_each_part_is_missing_and_nothing_else():
    plain, keypoints = what_it_gets()
    jax.tree.map(np.testing.assert_array_equal, plain, SEEN)
    grey, _ = what_it_gets("colour")
    assert np.unique(grey.pictures.rgb).tolist() == [128]
    np.testing.assert_array_equal(grey.pictures.depth, SEEN.pictures.depth)
    flat, _ = what_it_gets("depth")
    assert not flat.pictures.depth.any()
    np.testing.assert_array_equal(flat.pictures.rgb, SEEN.pictures.rgb)
    _, none = what_it_gets("keypoint")
    assert keypoints is not None
    assert none is None
    other, near = what_it_gets("own_pictures")
    np.testing.assert_array_equal(other.pictures.rgb, SEEN.pictures.rgb[[2, 3, 0, 1]])
    np.testing.assert_array_equal(other.pictures.depth, SEEN.pictures.depth[[2, 3, 0, 1]])
    jax.tree.map(np.testing.assert_array_equal, other.robot, SEEN.robot)
    np.testing.assert_array_equal(near, KEYPOINTS)


def test_the_conditions_of_results_name_the_parts():
    conditions = Conditions(withheld=check_parts(["depth", "colour", "depth"]))
    assert conditions.withheld == ("colour", "depth")
    assert conditions.describe() == "mujoco, without colour, without depth"
    assert conditions_from_json(json.loads(json.dumps(dataclasses.asdict(conditions)))) == conditions
    assert Conditions(withheld=PARTS).describe().endswith("without own pictures")


def test_what_cannot_be_withheld_is_refused():
    with pytest.raises(UserError, match="withhold: expected colour, depth, keypoint, own_pictures, got sound"):
        check_parts(["sound"])
    alone = jax.tree.map(lambda x: x[:1], SEEN)
    with pytest.raises(UserError, match="own_pictures needs another episode beside each"):
        withholding(lambda *_: _, ("own_pictures",))(alone, ["do it"], None)
