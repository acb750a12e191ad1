"""Keypoints of simulated episodes as perception finds them in the pictures, with a perfect detector.

The paper finds them so (section 3.3), with Grounding DINO and SAM in the place of the simulator's segmentation.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Literal

import jax
import numpy as np

from dsvla_jax.perception.keypoints import KeypointsNotFound, KeypointTracker, Sighting
from dsvla_jax.perception.phrases import ObjectPhrases
from dsvla_jax.sim.environment import Environment
from dsvla_jax.sim.objects import object_masks
from dsvla_jax.sim.physics import SimState
from dsvla_jax.sim.tasks import TASKS
from dsvla_jax.types import Observation

Keypoints = Literal["oracle", "segmentation", "segmentation-refresh"]


def suite_phrases() -> tuple[ObjectPhrases, ...]:
    """How to recognise the task suite's instructions, and the phrases of the objects that they name."""
    return tuple(
        ObjectPhrases(task.name, task.recognised_by, task.phrases({})) for task in TASKS.values() if task.recognised_by
    )


def keypoint_source(kind: Keypoints, environment: Environment) -> "Callable[[SimState], SegmentationKeypoints] | None":
    """What makes the source of a batch of the environment's episodes from its reset state.

    kind: `oracle`: None, for the task's own keypoints. `segmentation`: found in the first picture.
    `segmentation-refresh`: in the picture before every keyframe.
    """
    if kind == "oracle":
        return None
    return functools.partial(SegmentationKeypoints, environment, refresh=kind == "segmentation-refresh")


class SegmentationKeypoints:
    """Finds the keypoints of a batch of simulated episodes; a `loop.KeypointSource`.

    The simulator's masks of the task's objects, and the depth seen on them, go through the geometry that a robot's
    pictures go through. All are the front camera's, whatever cameras the policy has.

    state: the reset state of the B episodes. refresh: looks again before every keyframe, see `KeypointTracker`;
    otherwise the first frame's keypoints are kept. Raises UserError for a task that names no objects.
    """

    def __init__(self, environment: Environment, state: SimState, refresh: bool = False) -> None:
        self._environment = environment
        task = environment.task
        self._arms = [task.phrases(task.words(variation)) for variation in np.asarray(state.variation).tolist()]
        self._trackers = [KeypointTracker(functools.partial(self._segment, i), refresh) for i in range(len(self._arms))]
        self._refresh, self._masks = refresh, np.zeros(0, bool)
        self._rgb, self._depth = np.zeros(0, np.uint8), np.zeros(0, np.float32)

    def __call__(self, state: SimState, _: Observation) -> tuple[np.ndarray, list[str]]:
        """float32 (B, A, K, 3), and for each episode why it has none; the keypoints of such a one are zeros."""
        if self._refresh or not self._masks.size:
            seen = self._environment.render(state)
            self._masks = object_masks(self._environment, state, seen)
            self._rgb, self._depth = np.asarray(seen.rgb), np.asarray(seen.depth)
        rgb, depth = self._rgb, self._depth
        # Taking an episode's out of a device's arrays costs a program for each.
        cameras = jax.tree.map(np.asarray, state.camera)
        most = max(len(arm) for arm in self._arms[0])
        points = np.zeros((len(rgb), self._environment.num_arms, most, 3), np.float32)
        problems = [""] * len(rgb)
        for i, (tracker, arms) in enumerate(zip(self._trackers, self._arms, strict=True)):
            try:
                camera = jax.tree.map(lambda x, i=i: x[i], cameras)
                points[i] = tracker.keypoints(rgb[i], depth[i], camera, arms)
            except KeypointsNotFound as problem:
                problems[i] = str(problem)
        return points, problems

    def _segment(self, i: int, rgb: np.ndarray, phrases: Sequence[str]) -> list[Sighting]:
        masks = {phrase: mask for arm in self._arms[i] for phrase, mask in zip(arm, self._masks[i], strict=True)}
        return [Sighting(phrase, masks[phrase]) for phrase in phrases]
