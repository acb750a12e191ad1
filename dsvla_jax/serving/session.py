"""What the server remembers of one connection: its keypoints, and how many each arm has reached in this episode."""

from collections.abc import Sequence

import numpy as np

from dsvla_jax.encoding.keypoints import active_keypoint, advance_latch
from dsvla_jax.perception.keypoints import KeypointTracker
from dsvla_jax.serving.requests import Request


class Session:
    """The keypoint constraint in time, for one robot.

    An episode begins with the connection, with ``reset``, and where the instruction or the number of keypoints changes.
    tracker: finds keypoints in pictures, for a robot that sends none.
    """

    def __init__(self, tracker: KeypointTracker | None = None) -> None:
        self._tracker = tracker
        self._instruction: str | None = None
        self._shape: tuple[int, ...] = ()
        self._reached = np.zeros(0, np.int32)

    def look(self, request: Request, arms: Sequence[Sequence[str]]) -> np.ndarray:
        """The keypoints (A, K, 3) of the phrases for each arm, seen in this picture or before in the episode."""
        if self._tracker is None:
            raise ValueError("Session.look: made without a tracker")
        if request.reset or request.instruction != self._instruction:
            self._tracker.reset()
        seen = request.observation
        return self._tracker.keypoints(np.asarray(seen.rgb), np.asarray(seen.depth), seen.camera, arms)

    def advance(self, request: Request, keypoints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The active one of each arm's keypoints (A, K, 3), float32 (A, 3), and how many it has reached, int32 (A,)."""
        shape = keypoints.shape[:2]
        if request.reset or request.instruction != self._instruction or shape != self._shape:
            self._instruction, self._shape, self._reached = request.instruction, shape, np.zeros(shape[0], np.int32)
        positions = np.asarray(request.observation.pose)[:, :3]
        self._reached = np.asarray(advance_latch(self._reached, positions, keypoints))
        active = [active_keypoint(count, row) for count, row in zip(self._reached, keypoints, strict=True)]
        return np.stack([np.asarray(point) for point in active]), self._reached
