"""What the server remembers of one connection: its keypoints, and how many each arm has reached in this episode."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from dsvla_jax.encoding.keypoints import active_keypoint, advance_latch
from dsvla_jax.encoding.past import first_past, remember
from dsvla_jax.perception.keypoints import KeypointTracker
from dsvla_jax.serving.requests import Request
from dsvla_jax.types import Past, RobotState, split_cameras


@dataclasses.dataclass(frozen=True)
class Progress:
    """Of an episode. shape: (A, K) of its keypoints. reached: int32 (A,), how many of them each arm has reached."""

    instruction: str
    shape: tuple[int, ...]
    reached: np.ndarray


class Session:
    """The keypoint constraint in time, for one robot.

    An episode begins with the connection, with ``reset``, and when the instruction or the number of keypoints changes.
    A request that is refused changes nothing: progress counts once it is given to `keep`.
    tracker: finds keypoints in pictures, for a robot that sends none.
    """

    def __init__(self, tracker: KeypointTracker | None = None) -> None:
        self._tracker = tracker
        self._progress: Progress | None = None
        self._past: tuple[str, RobotState[np.ndarray], Past[np.ndarray]] | None = None

    def look(self, request: Request, arms: Sequence[Sequence[str]]) -> np.ndarray:
        """The keypoints (A, K, 3) of the phrases for each arm, seen in this picture or before in the episode.

        Of several cameras, the first one's picture is looked at.
        """
        if self._tracker is None:
            raise ValueError("Session.look: made without a tracker")
        if request.reset or self._progress is None or request.instruction != self._progress.instruction:
            self._tracker.reset()
        seen = split_cameras(request.observation.pictures)[0]
        return self._tracker.keypoints(seen.rgb, seen.depth, seen.camera, arms)

    def begins(self, request: Request, keypoints: np.ndarray) -> bool:
        """Whether an episode begins with this request and its keypoints (A, K, 3)."""
        known = self._progress
        same = known is not None and (known.instruction, known.shape) == (request.instruction, keypoints.shape[:2])
        return request.reset or not same

    def advance(self, request: Request, keypoints: np.ndarray) -> tuple[np.ndarray, Progress]:
        """The active one of each arm's keypoints (A, K, 3), float32 (A, 3), and the progress to `keep` with it."""
        shape = keypoints.shape[:2]
        before = np.zeros(shape[0], np.int32)
        if self._progress is not None and not self.begins(request, keypoints):
            before = self._progress.reached
        positions = np.asarray(request.observation.robot.pose)[:, :3]
        reached = np.asarray(advance_latch(before, positions, keypoints))
        active = [active_keypoint(count, row) for count, row in zip(reached, keypoints, strict=True)]
        return np.stack([np.asarray(point) for point in active]), Progress(request.instruction, shape, reached)

    def look_back(self, request: Request, begins: bool) -> Past[np.ndarray]:
        """What the episode has been before this request, which becomes part of it.

        begins: whether an episode begins with the request's keypoints; one begins with another instruction, or another
        number of arms, in any case.
        """
        robot, known = request.observation.robot, self._past
        same = known is not None and (known[0], known[1].pose.shape) == (request.instruction, robot.pose.shape)
        past = remember(known[2], known[1]) if known and same and not (begins or request.reset) else first_past(robot)
        self._past = request.instruction, robot, past
        return past

    def keep(self, progress: Progress) -> None:
        """Takes over the progress of a request that is answered."""
        self._progress = progress
