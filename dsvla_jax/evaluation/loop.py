"""The closed loop: a policy acts in many episodes of one task at a time.

A policy is any function (Observation, B instructions, active keypoints (B, A, 3)) -> (Action, B answers as text).
"""

import contextlib
import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Generic, NamedTuple, Protocol, TypeVar

import jax
import numpy as np
from jaxtyping import Float, Int
from tqdm import tqdm

from dsvla_jax.compile_times import first_use
from dsvla_jax.encoding.keypoints import active_keypoint, advance_latch
from dsvla_jax.encoding.past import first_past, remember
from dsvla_jax.errors import UserError
from dsvla_jax.evaluation.outcome import EpisodeOutcome, View, failure_reasons, is_over, views_of
from dsvla_jax.sim.environment import Environment
from dsvla_jax.sim.physics import SimState
from dsvla_jax.sim.seeds import episode_keys
from dsvla_jax.types import Action, Array, Observation, Past

Act = Callable[[Observation, Sequence[str], np.ndarray], tuple[Action, Sequence[str]]]
# State and what is seen of it -> keypoints (B, A, K, 3), and why an episode has none, empty where it has.
KeypointSource = Callable[[SimState, Observation], tuple[np.ndarray, Sequence[str]]]
Answer = TypeVar("Answer")


class Turn(NamedTuple, Generic[Answer]):
    """What one step of the loop leaves: the state after the keyframe, the latches int32 (B, A), action and answer."""

    state: SimState
    latched: Array
    past: Past
    action: Action
    answer: Answer


def policy_step(
    state: SimState,
    observation: Observation,
    past: Past,
    latched: Int[Array | np.ndarray, "b a"],
    keypoints: Float[Array | np.ndarray, "b a k 3"],
    decide: Callable[[Observation, Array], tuple[Action, Answer]],
    step: Callable[[SimState, Action], SimState],
) -> Turn[Answer]:
    """One step of the closed loop: advances the keypoint latches, asks the policy, moves to the keyframe.

    past: of the episodes, before this observation. decide: (observation, active keypoints (B, A, 3)) -> (action,
    answer). step: of the environment. The host's loop and the device's are both made of it; it can be traced if both
    functions can.
    """
    latched = jax.vmap(advance_latch)(latched, observation.robot.pose[..., :3], keypoints)
    active = jax.vmap(jax.vmap(active_keypoint))(latched, keypoints)
    action, answer = decide(dataclasses.replace(observation, past=past), active)
    return Turn(step(state, action), latched, remember(past, observation.robot), action, answer)


class Stopped(Exception):
    """Episodes were given up half-way, because `run_task` was asked to stop."""


class RunEpisodes(Protocol):
    """Runs the B episodes of a reset state to their ends: `on_host(environment, act)` or a `DeviceLoop`."""

    def __call__(
        self,
        state: SimState,
        *,
        first: int,
        noise: np.ndarray,
        find_keypoints: KeypointSource | None,
        on_keyframe: Callable[[int, int], None],
    ) -> list[EpisodeOutcome]:
        """See `run_episodes`."""
        ...


def on_host(environment: Environment, act: Act) -> RunEpisodes:
    """Returns the loop that asks the policy from the host, see `run_episodes`."""
    return functools.partial(run_episodes, environment, act)


def run_task(
    environment: Environment,
    run: RunEpisodes,
    episodes: int,
    *,
    split: str,
    seed: int = 0,
    batch: int = 100,
    keypoint_noise: float = 0.0,
    find_keypoints: Callable[[SimState], KeypointSource] | None = None,
    label: str = "",
    stop: Callable[[], bool] = lambda: False,
) -> list[EpisodeOutcome]:
    """Runs the first `episodes` of a split's stream of one task, `batch` of them side by side, with a progress bar.

    Noise and paraphrase belong to an episode's number: the size of a batch changes neither.

    Args:
        run: the loop, on the host or on the device.
        keypoint_noise: metres of uniform noise an axis on every keypoint.
        find_keypoints: makes what finds the keypoints of a batch from its reset state; the task's own if not given.
        label: for people, instead of the task's name.
        stop: asked after every keyframe; raises Stopped if it returns True.

    Raises UserError for fewer than one episode, or fewer than one side by side.
    """
    if episodes < 1 or batch < 1:
        raise UserError(f"episodes and batch: expected at least 1 of each, got {episodes} and {batch}")
    name, size = environment.task.name, min(episodes, batch)
    outcomes: list[EpisodeOutcome] = []
    random = np.random.default_rng([seed, 0])
    with tqdm(total=episodes, desc=label or name, unit="episode", leave=None) as bar:

        def report(done: int, succeeded: int) -> None:
            bar.set_postfix_str(f"keyframe {done}, {succeeded}/{size} succeeded")
            if stop():
                raise Stopped

        for start in range(0, episodes, size):
            # The last batch is filled up with further episodes: another size would compile again.
            keys = episode_keys(seed, split, name, start, size)
            compiling = first_use(f"{label or name} x {size}", bar.set_postfix_str)
            with compiling if start == 0 else contextlib.nullcontext():
                state = environment.reset(keys)
                keypoints = environment.keypoints(state)
            noise = random.uniform(-1, 1, keypoints.shape) * keypoint_noise
            found = None if find_keypoints is None else find_keypoints(state)
            outcomes += run(state, first=start, noise=noise, find_keypoints=found, on_keyframe=report)
            bar.update(min(size, episodes - start))
    return outcomes[:episodes]


def run_episodes(
    environment: Environment,
    act: Act,
    state: SimState,
    limit: int | None = None,
    first: int = 0,
    noise: np.ndarray | float = 0.0,
    find_keypoints: KeypointSource | None = None,
    on_keyframe: Callable[[int, int], None] = lambda done, succeeded: None,
) -> list[EpisodeOutcome]:
    """Runs the episodes of a reset state to their ends, side by side; the policy is asked from the host.

    Args:
        limit: keyframes after which an episode is over; twice the expert's if not given.
        first: the number of the first episode, which chooses the paraphrases of the instruction.
        noise: metres added to the keypoints, (B, A, K, 3) for the task's K or a number.
        find_keypoints: asked before every keyframe; the task's own keypoints at the start if not given. An episode for
            which it has none is over.
        on_keyframe: called with the number of keyframes done and of successes so far.
    """
    batch = state.qpos.shape[0]
    instructions = environment.instructions(state, np.arange(first, first + batch))
    own, no_problem = np.asarray(environment.keypoints(state)), [""] * batch
    noise = np.broadcast_to(noise, own.shape)
    latched: np.ndarray | Array = np.zeros(own.shape[:2], np.int32)
    problems = no_problem
    seen: list[list[View]] = [[] for _ in range(batch)]
    answers: list[list[str]] = [[] for _ in range(batch)]
    targets: list[list[np.ndarray]] = [[] for _ in range(batch)]
    over = np.array(is_over(state))
    past: Past | None = None

    def decide(observation: Observation, active: Array) -> tuple[Action, Sequence[str]]:
        return act(observation, instructions, np.asarray(active))

    for done in range(1, (limit or 2 * environment.expert_keyframes) + 1):
        if over.all():
            break
        observation = environment.observe(state)
        keypoints, missing = find_keypoints(state, observation) if find_keypoints else (own, no_problem)
        keypoints = (keypoints + noise[:, :, : keypoints.shape[2]]).astype(np.float32)
        problems = [old or new for old, new in zip(problems, missing, strict=True)]
        over |= np.array([bool(problem) for problem in problems])
        past = first_past(observation.robot) if past is None else past
        turn = policy_step(state, observation, past, latched, keypoints, decide, environment.step)
        state, latched, past, action, texts = turn
        views, positions = views_of(observation), np.asarray(action.pose)[..., :3]
        for i in np.flatnonzero(~over).tolist():
            seen[i].append(views[i])
            answers[i].append(texts[i])
            targets[i].append(positions[i])
        over |= np.asarray(is_over(state))
        on_keyframe(done, int(np.sum(environment.success(state))))
    last, reasons = views_of(environment.observe(state)), failure_reasons(environment, state)
    reasons = [problem or reason for problem, reason in zip(problems, reasons, strict=True)]
    return [
        EpisodeOutcome(
            success=not reasons[i],
            reason=reasons[i],
            keyframes=len(seen[i]),
            instruction=instructions[i],
            answers=answers[i],
            views=[*seen[i], last[i]],
            targets=targets[i],
        )
        for i in range(batch)
    ]
