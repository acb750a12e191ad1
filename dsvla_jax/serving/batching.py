"""Micro-batching: requests that wait at the same moment are answered together, in batches of sizes compiled before."""

import asyncio
import dataclasses
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

import jax
import numpy as np

from dsvla_jax.geometry.cameras import front_camera
from dsvla_jax.policy import Policy
from dsvla_jax.types import TABLE_HEIGHT, Observation


@dataclasses.dataclass(frozen=True)
class Question:
    """One robot's turn. observation: NumPy arrays without a batch axis. keypoints: active ones (A, 3), or None."""

    instruction: str
    observation: Observation
    keypoints: np.ndarray | None

    @property
    def shape(self) -> tuple[int, ...]:
        """(A, H, W): questions of one shape can share a batch."""
        return (*self.observation.gripper_open.shape, *self.observation.depth.shape)


@dataclasses.dataclass(frozen=True)
class Answer:
    """The next key pose of one robot: pose float32 (A, 7), gripper_open float32 (A,), and the text that says it."""

    pose: np.ndarray
    gripper_open: np.ndarray
    text: str


@dataclasses.dataclass(frozen=True)
class Timing:
    """Seconds that a question waited, and that its batch of so many robots took."""

    waited: float
    answering: float
    batch: int


AnswerBatch = Callable[[Sequence[Question], int], Sequence[Answer]]


def batch_sizes(largest: int) -> tuple[int, ...]:
    """1, 2, 4, ... and ``largest``: what is compiled. Padding to the next of them at most doubles the work."""
    return (*(2**i for i in range((largest - 1).bit_length())), largest)


def answer_batch(policy: Policy, questions: Sequence[Question], size: int) -> list[Answer]:
    """Answers at most ``size`` questions of one shape, as a batch of ``size`` padded with the first of them."""
    padded = [*questions, *[questions[0]] * (size - len(questions))]
    observation = jax.tree.map(lambda *leaves: np.stack(leaves), *[question.observation for question in padded])
    with_keypoints = policy.config.encoding.use_keypoints
    keypoints = np.stack([np.asarray(question.keypoints) for question in padded]) if with_keypoints else None
    action, texts = policy.act(observation, [question.instruction for question in padded], keypoints)
    poses, grippers = np.asarray(action.pose), np.asarray(action.gripper_open)
    return [Answer(poses[i], grippers[i], texts[i]) for i in range(len(questions))]


def blank_question(arms: int, height: int, width: int) -> Question:
    """A well-formed question about an empty table, for warming up."""
    camera = jax.tree.map(np.asarray, front_camera(height))
    pose = np.tile(np.array([0.3, 0.0, TABLE_HEIGHT + 0.5, 0.0, 1.0, 0.0, 0.0], np.float32), (arms, 1))
    observation = Observation(
        rgb=np.zeros((height, width, 3), np.uint8),  # type: ignore[arg-type]
        depth=np.ones((height, width), np.float32),  # type: ignore[arg-type]
        camera=camera,
        pose=pose,  # type: ignore[arg-type]
        gripper_open=np.ones(arms, np.float32),  # type: ignore[arg-type]
    )
    return Question("wait", observation, pose[:, :3])


class MicroBatcher:
    """Answers questions in the order of their arrival, all that wait and have one shape together.

    No question is held back for company: a batch forms out of what arrives while the one before is being answered.
    ``answer`` runs in a thread of its own, so that connections stay alive; ``sizes`` are those it is compiled for.
    """

    def __init__(self, answer: AnswerBatch, sizes: Sequence[int]):
        self._answer, self._sizes = answer, sizes
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
            size = next(size for size in self._sizes if size >= len(batch))
            started = time.monotonic()
            try:
                answers = await loop.run_in_executor(self._thread, self._answer, [item[0] for item in batch], size)
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
        batch = [item for item in waiting if item[0].shape == shape][: self._sizes[-1]]
        taken = {id(item) for item in batch}
        self._waiting = [item for item in waiting if id(item) not in taken]
        return batch
