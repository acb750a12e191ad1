"""Micro-batching: requests that wait at the same moment are answered together."""

import asyncio
import dataclasses
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

import jax
import numpy as np

from dsvla_jax.encoding.past import first_past
from dsvla_jax.geometry.cameras import front_camera
from dsvla_jax.policies.interface import BATCH_SIZES, Policy
from dsvla_jax.types import TABLE_HEIGHT, Observation, Picture, RobotState, join_cameras


@dataclasses.dataclass(frozen=True)
class Question:
    """One robot's turn. observation: NumPy arrays without a batch axis. keypoints: active ones (A, 3), or None."""

    instruction: str
    observation: Observation[np.ndarray]
    keypoints: np.ndarray | None

    @property
    def shape(self) -> tuple[int, ...]:
        """(A, C, H, W): questions of one shape can share a batch."""
        return (*self.observation.robot.gripper_open.shape, *self.observation.pictures.depth.shape)


@dataclasses.dataclass(frozen=True)
class Answer:
    """The next keyframe of one robot: pose float32 (A, 7), gripper_open float32 (A,), and the text that says it.

    log_probs: A lists of 8, of each number of the text; empty for a policy that answers with poses.
    """

    pose: np.ndarray
    gripper_open: np.ndarray
    text: str
    log_probs: list[list[float]]


@dataclasses.dataclass(frozen=True)
class Timing:
    """Seconds that a question waited, and that its batch of so many robots took."""

    waited: float
    answering: float
    batch: int


def batch_sizes(largest: int) -> tuple[int, ...]:
    """Of the sizes to which a policy fills up batches, those up to ``largest``."""
    return tuple(size for size in BATCH_SIZES if size <= largest)


def prompt_length(policy: Policy, arms: int, instruction_tokens: int) -> int:
    """Tokens of a prompt with numbers of the most digits and an instruction of so many tokens; at most the policy's."""
    codec = policy.config.encoding.codec
    pose = np.tile(np.array([*codec.low[:2], codec.high[2], -0.5, -0.5, -0.5, 0.5], np.float32), (arms, 1))
    keypoints = pose[:, :3] if policy.config.wants_keypoints else None
    text = policy.encode_prompt("", RobotState(pose, np.ones(arms, np.float32)), keypoints)
    return min(policy.config.encoding.max_text_length, int(text.mask.sum()) + instruction_tokens)


def answer_batch(policy: Policy, questions: Sequence[Question], prompt_tokens: int | None = None) -> list[Answer]:
    """Answers questions of one shape together, their prompts padded to ``prompt_tokens``."""
    observation = jax.tree.map(lambda *leaves: np.stack(leaves), *[question.observation for question in questions])
    wanted = policy.config.wants_keypoints
    keypoints = np.stack([np.asarray(question.keypoints) for question in questions]) if wanted else None
    instructions = [question.instruction for question in questions]
    decision = policy.decide(observation, instructions, keypoints, prompt_tokens=prompt_tokens)
    poses, grippers = np.asarray(decision.action.pose), np.asarray(decision.action.gripper_open)
    return [
        Answer(poses[i], grippers[i], text, [] if decision.log_probs is None else decision.log_probs[i].tolist())
        for i, text in enumerate(decision.texts)
    ]


def blank_question(arms: int, cameras: int, height: int, width: int) -> Question:
    """A well-formed question about an empty table, for warming up."""
    camera = jax.tree.map(np.asarray, front_camera(height))
    pose = np.tile(np.array([0.3, 0.0, TABLE_HEIGHT + 0.5, 0.0, 1.0, 0.0, 0.0], np.float32), (arms, 1))
    picture = Picture(np.zeros((height, width, 3), np.uint8), np.ones((height, width), np.float32), camera)
    robot = RobotState(pose, np.ones(arms, np.float32))
    observation = Observation(join_cameras([picture] * cameras), robot, first_past(robot))
    return Question("", observation, pose[:, :3])


class MicroBatcher:
    """Answers questions in the order of their arrival, all that wait and have one shape together.

    No question is held back for company: a batch forms out of what arrives while the one before is being answered.
    ``answer`` runs in a thread of its own, so that connections stay alive. largest: most questions of a batch.
    """

    def __init__(self, answer: Callable[[Sequence[Question]], Sequence[Answer]], largest: int) -> None:
        self._answer, self._largest = answer, largest
        self._waiting: list[tuple[Question, asyncio.Future[tuple[Answer, Timing]], float]] = []
        self._arrived = asyncio.Event()
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="policy")

    async def ask(self, question: Question) -> tuple[Answer, Timing]:
        """The answer; raises what answering raised. Whoever is cancelled while waiting leaves the queue."""
        future = asyncio.get_running_loop().create_future()
        self._waiting.append((question, future, time.monotonic()))
        self._arrived.set()
        return await future

    async def run(self) -> None:
        """Answers for ever; cancel it to stop."""
        loop = asyncio.get_running_loop()
        while True:
            batch = self._take()
            if not batch:
                self._arrived.clear()
                await self._arrived.wait()
                continue
            started = time.monotonic()
            try:
                answers = await loop.run_in_executor(self._thread, self._answer, [item[0] for item in batch])
            except Exception as error:
                # Whatever went wrong, those who wait are told, and the next batch has its chance.
                for _, future, _ in batch:
                    if not future.done():
                        future.set_exception(error)
                continue
            answering = time.monotonic() - started
            for (_, future, since), answer in zip(batch, answers, strict=True):
                if not future.done():
                    future.set_result((answer, Timing(started - since, answering, len(batch))))

    def _take(self) -> list:
        """Removes the next batch from the queue, and those who no longer wait."""
        waiting = [item for item in self._waiting if not item[1].done()]
        shape = waiting[0][0].shape if waiting else ()
        batch = [item for item in waiting if item[0].shape == shape][: self._largest]
        taken = {id(item) for item in batch}
        self._waiting = [item for item in waiting if id(item) not in taken]
        return batch
