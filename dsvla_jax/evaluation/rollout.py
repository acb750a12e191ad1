"""Closed loop on the host: a policy acts in many episodes of one task at a time, and why each ended as it did.

A policy is any function (Observation, B instructions, active keypoints (B, A, 3)) -> (Action, B answers as text).
"""

import contextlib
import dataclasses
from collections.abc import Callable, Sequence

import jax
import numpy as np
from tqdm import tqdm

from dsvla_jax.compile_times import first_use
from dsvla_jax.encoding.keypoints import active_keypoint, advance_latch
from dsvla_jax.errors import UserError
from dsvla_jax.sim.environment import Environment
from dsvla_jax.sim.physics import SimState
from dsvla_jax.sim.seeds import episode_keys
from dsvla_jax.types import Action, Camera, Observation

Act = Callable[[Observation, Sequence[str], np.ndarray], tuple[Action, Sequence[str]]]
# State and what is seen of it -> keypoints (B, A, K, 3), and why an episode has none, empty where it has.
KeypointSource = Callable[[SimState, Observation], tuple[np.ndarray, Sequence[str]]]


@dataclasses.dataclass(frozen=True)
class Ending:
    """One finished episode.

    reason: why it failed, empty on success. keyframes: key poses executed. answers: the policy's text for each.
    frames: uint8 (H, W, 3), what the policy saw before each key pose, and the last view. camera: of the frames.
    targets: float32 (A, 3), the position that it answered to each frame but the last.
    """

    success: bool
    reason: str
    keyframes: int
    instruction: str
    answers: list[str]
    frames: list[np.ndarray]
    camera: Camera
    targets: list[np.ndarray]


class Stopped(Exception):
    """Episodes were given up half-way, because `run_task` was told to stop."""


def run_task(
    environment: Environment,
    act: Act,
    episodes: int,
    *,
    split: str,
    seed: int = 0,
    batch: int = 100,
    keypoint_noise: float = 0.0,
    find_keypoints: Callable[[SimState], KeypointSource] | None = None,
    label: str = "",
    stop: Callable[[], bool] = lambda: False,
) -> list[Ending]:
    """The first `episodes` of a split's stream of one task, `batch` of them side by side, with a progress bar.

    keypoint_noise: metres of uniform noise an axis on every keypoint.
        Noise and paraphrase belong to an episode's number: the size of a batch changes neither.
    find_keypoints: makes what finds the keypoints of a batch from its reset state; the task's own if not given.
    label: for people, in place of the task's name.
    stop: asked after every key pose; raises Stopped where it says so.
    Raises UserError for fewer than one episode, or fewer than one side by side.
    """
    if episodes < 1 or batch < 1:
        raise UserError(f"episodes and batch: expected at least 1 of each, got {episodes} and {batch}")
    name, size = environment.task.name, min(episodes, batch)
    endings: list[Ending] = []
    random = np.random.default_rng([seed, 0])
    with tqdm(total=episodes, desc=label or name, unit="episode", leave=None) as bar:

        def told(done: int, succeeded: int) -> None:
            bar.set_postfix_str(f"key pose {done}, {succeeded}/{size} succeeded")
            if stop():
                raise Stopped

        for start in range(0, episodes, size):
            # The last batch is filled up with further episodes: another size would compile again.
            keys = episode_keys(seed, split, name, start, size)
            compiling = first_use(f"{label or name} x {size}", bar.set_postfix_str)
            with compiling if start == 0 else contextlib.nullcontext():
                state = environment.reset(keys)
                keypoints = environment.keypoints(state)
            noise = random.uniform(-1, 1, keypoints.shape)
            found = None if find_keypoints is None else find_keypoints(state)
            endings += run_episodes(
                environment,
                act,
                state,
                first=start,
                noise=noise * keypoint_noise,
                find_keypoints=found,
                on_keyframe=told,
            )
            bar.update(min(size, episodes - start))
    return endings[:episodes]


def run_episodes(
    environment: Environment,
    act: Act,
    state: SimState,
    limit: int | None = None,
    first: int = 0,
    noise: np.ndarray | float = 0.0,
    find_keypoints: KeypointSource | None = None,
    on_keyframe: Callable[[int, int], None] = lambda done, succeeded: None,
) -> list[Ending]:
    """Runs the episodes of a reset state to their ends, side by side.

    limit: key poses after which an episode is over; twice the expert's if not given.
    first: the number of the first episode, which chooses the paraphrases of the instruction.
    noise: metres added to the keypoints, (B, A, K, 3) for the task's K or a number.
    find_keypoints: asked before every key pose; the task's own keypoints at the start if not given. An episode for
        which it has none is over.
    on_keyframe: told the number of key poses done and of successes so far.
    """
    batch = state.qpos.shape[0]
    instructions = environment.instructions(state, np.arange(first, first + batch))
    own, no_problem = np.asarray(environment.keypoints(state)), [""] * batch
    noise = np.broadcast_to(noise, own.shape)
    latched = np.zeros(own.shape[:2], np.int32)
    problems = no_problem
    seen: list[list[np.ndarray]] = [[] for _ in range(batch)]
    answers: list[list[str]] = [[] for _ in range(batch)]
    targets: list[list[np.ndarray]] = [[] for _ in range(batch)]
    over = has_ended(state)
    for done in range(1, (limit or 2 * environment.expert_keyframes) + 1):
        if over.all():
            break
        observation = environment.observe(state)
        keypoints, missing = find_keypoints(state, observation) if find_keypoints else (own, no_problem)
        keypoints = (keypoints + noise[:, :, : keypoints.shape[2]]).astype(np.float32)
        problems = [old or new for old, new in zip(problems, missing, strict=True)]
        over |= np.array([bool(problem) for problem in problems])
        latched = np.asarray(jax.vmap(advance_latch)(latched, observation.robot.pose[..., :3], keypoints))
        active = np.asarray(jax.vmap(jax.vmap(active_keypoint))(latched, keypoints))
        action, texts = act(observation, instructions, active)
        rgb, positions = np.asarray(observation.picture.rgb), np.asarray(action.pose)[..., :3]
        for i in np.flatnonzero(~over).tolist():
            seen[i].append(rgb[i])
            answers[i].append(texts[i])
            targets[i].append(positions[i])
        state = environment.step(state, action)
        over |= has_ended(state)
        on_keyframe(done, int(np.sum(environment.success(state))))
    last, reasons = np.asarray(environment.observe(state).picture.rgb), failure_reasons(environment, state)
    reasons = [problem or reason for problem, reason in zip(problems, reasons, strict=True)]
    return [
        Ending(
            success=not reasons[i],
            reason=reasons[i],
            keyframes=len(seen[i]),
            instruction=instructions[i],
            answers=answers[i],
            frames=[*seen[i], last[i]],
            camera=jax.tree.map(lambda x, i=i: x[i], state.camera),
            targets=targets[i],
        )
        for i in range(batch)
    ]


def has_ended(state: SimState) -> np.ndarray:
    """bool (B,): nothing that is still to come can change the outcome."""
    return np.asarray(state.verdict.succeeded) | np.asarray(state.verdict.failed) | np.asarray(state.diverged)


def failure_reasons(environment: Environment, state: SimState) -> list[str]:
    """Why each of the B episodes has not succeeded, the gravest reason first; empty where it has."""
    checks = {
        "the simulation diverged": state.diverged,
        "entered the fail zone": state.verdict.failed,
        "took the wrong object": environment.took_wrong_object(state),
        "a pose was out of reach": state.ik_failed,
        "dropped the object": environment.dropped(state),
    }
    found = {reason: np.asarray(check) for reason, check in checks.items()}
    succeeded = np.asarray(environment.success(state))
    return [
        "" if succeeded[i] else next((reason for reason, check in found.items() if check[i]), "time-out")
        for i in range(len(succeeded))
    ]
