"""What the server remembers of one connection: how many keypoints each arm has reached in this episode."""

import numpy as np

from dsvla_jax.encoding.keypoints import active_keypoint, advance_latch
from dsvla_jax.serving.requests import Request


class Session:
    """The keypoint constraint in time, for one robot.

    An episode begins with the connection, with ``reset``, and where the instruction or the number of keypoints changes.
    """

    def __init__(self) -> None:
        self._episode: tuple | None = None
        self._reached = np.zeros(0, np.int32)

    def advance(self, request: Request, keypoints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The active one of each arm's keypoints (A, K, 3), float32 (A, 3), and how many it has reached, int32 (A,)."""
        episode = (request.instruction, keypoints.shape)
        if request.reset or episode != self._episode:
            self._episode, self._reached = episode, np.zeros(len(keypoints), np.int32)
        positions = np.asarray(request.observation.pose)[:, :3]
        self._reached = np.asarray(advance_latch(self._reached, positions, keypoints))
        active = [active_keypoint(count, row) for count, row in zip(self._reached, keypoints, strict=True)]
        return np.stack([np.asarray(point) for point in active]), self._reached
