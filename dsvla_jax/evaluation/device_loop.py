"""The closed loop on the device: observe, encode, decode, execute and judge many episodes as one jitted function.

`loop.run_episodes` is the reference, which asks the policy from the host; both give the same episodes.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Float, Int

from dsvla_jax.encoding.past import first_past
from dsvla_jax.evaluation.loop import KeypointSource, policy_step
from dsvla_jax.evaluation.outcome import EpisodeOutcome, failure_reasons, is_over, views_of
from dsvla_jax.model.variables import Variables
from dsvla_jax.policies.interface import DevicePolicy, Policy
from dsvla_jax.sim import environment as simulator
from dsvla_jax.sim.environment import Environment
from dsvla_jax.sim.physics import Physics, SimState, jit_with_mjx
from dsvla_jax.types import Action, Array, Observation, Past


@struct.dataclass
class Rollout:
    """What became of B episodes of at most L keyframes, on the device."""

    state: SimState
    """The last."""
    answers: object
    """Those of every keyframe, as the policy gives them, with an axis L in front; see `DevicePolicy`."""
    targets: Float[Array, "l b a 3"]
    """Positions of the keyframes; what follows an episode's end means nothing."""
    keyframes: Int[Array, " b"]
    """Keyframes that each episode had."""


class _Carry(NamedTuple):
    done: Array
    state: SimState
    latched: Array
    past: Past[Array]
    answers: object
    targets: Array
    keyframes: Array


Loop = Callable[[Physics, Variables, SimState, Array, object], Rollout]


def device_loop(environment: Environment, policy: DevicePolicy, limit: int) -> Loop:
    """The pure ``(physics, variables, state, keypoints, question) -> Rollout`` of an MJX environment.

    keypoints: float32 (B, A, K, 3), of the whole episode. question: see `DevicePolicy.ask`. limit: L.
    Raises ValueError for C physics.
    """
    if not environment.physics.traceable:
        raise ValueError(f"device_loop: expected Environment({environment.task.name!r}, physics='mjx'), not C MuJoCo's")
    arms = environment.num_arms

    def run(physics: Physics, variables: Variables, state: SimState, keypoints: Array, question: object) -> Rollout:
        batch = keypoints.shape[0]

        def decide(observation: Observation[Array], active: Array) -> tuple[Action[Array], object]:
            return policy.act(variables, observation, question, active)

        def goes_on(carry: _Carry) -> Array:
            return (carry.done < limit) & ~jnp.all(is_over(carry.state))

        def turn(carry: _Carry) -> _Carry:
            running = ~is_over(carry.state)
            state, latched, past, action, answer = policy_step(
                carry.state,
                environment.observe(carry.state),
                carry.past,
                carry.latched,
                keypoints,
                decide,
                functools.partial(simulator.step, environment.scene, physics),
            )
            answers = jax.tree.map(lambda kept, new: kept.at[carry.done].set(new), carry.answers, answer)
            targets = carry.targets.at[carry.done].set(action.pose[..., :3])
            return _Carry(carry.done + 1, state, latched, past, answers, targets, carry.keyframes + running)

        state, latched = jax.tree.map(jnp.asarray, state), jnp.zeros((batch, arms), jnp.int32)
        start = environment.observe(state)
        answer = jax.eval_shape(lambda: decide(start, keypoints[:, :, 0])[1])
        last = jax.lax.while_loop(
            goes_on,
            turn,
            _Carry(
                done=jnp.int32(0),
                state=state,
                latched=latched,
                past=first_past(start.robot),
                answers=jax.tree.map(lambda leaf: jnp.zeros((limit, *leaf.shape), leaf.dtype), answer),
                targets=jnp.zeros((limit, batch, arms, 3)),
                keyframes=jnp.zeros(batch, jnp.int32),
            ),
        )
        return Rollout(last.state, last.answers, last.targets, last.keyframes)

    return run


class DeviceLoop:
    """The loop on the device for a policy and a task; compiled once for each size of a batch. See `RunEpisodes`.

    environment: with physics "mjx". limit: keyframes after which an episode is over; twice the expert's if not given.
    """

    def __init__(self, environment: Environment, policy: Policy, limit: int | None = None) -> None:
        self._environment, self._variables, task = environment, policy.variables, environment.task
        self._policy = policy.on_device(task.num_arms, task.all_instructions())
        loop = device_loop(environment, self._policy, limit or 2 * environment.expert_keyframes)
        self._run = jit_with_mjx(loop)

    def rollout(
        self, state: SimState, keypoints: Float[Array | np.ndarray, "b a k 3"] | None = None, first: int = 0
    ) -> Rollout:
        """Runs the episodes of a reset state, and leaves what became of them on the device.

        keypoints: of the whole episode; the task's own if not given. first: see `loop.run_episodes`.
        """
        return self._ask(state, self._instructions(state, first), keypoints)

    def _ask(
        self, state: SimState, instructions: list[str], keypoints: Float[Array | np.ndarray, "b a k 3"] | None
    ) -> Rollout:
        keypoints = jnp.asarray(self._environment.keypoints(state) if keypoints is None else keypoints)
        question = self._policy.ask(instructions)
        return self._run(self._environment.physics, self._variables, state, keypoints, question)

    def __call__(
        self,
        state: SimState,
        *,
        first: int = 0,
        noise: np.ndarray | float = 0.0,
        find_keypoints: KeypointSource | None = None,
        on_keyframe: Callable[[int, int], None] = lambda done, succeeded: None,
    ) -> list[EpisodeOutcome]:
        """Runs the episodes of a reset state to their ends, with the outcomes that the loop on the host has.

        find_keypoints: asked once, before the first keyframe. An episode for which it has none fails for that reason.
        on_keyframe: called once, at the end. The rest as of `loop.run_episodes`.
        """
        environment, instructions = self._environment, self._instructions(state, first)
        keypoints, problems = np.asarray(environment.keypoints(state)), [""] * state.qpos.shape[0]
        noise = np.broadcast_to(noise, keypoints.shape)
        if find_keypoints is not None:
            keypoints, problems = find_keypoints(state, environment.observe(state))
        keypoints = (keypoints + noise[:, :, : keypoints.shape[2]]).astype(np.float32)
        rollout = self._ask(state, instructions, keypoints)
        targets, keyframes = np.asarray(rollout.targets), np.asarray(rollout.keyframes)
        texts = [self._policy.texts(answers) for answers in self._answers(rollout, int(keyframes.max()))]
        last = views_of(environment.observe(rollout.state))
        reasons = failure_reasons(environment, rollout.state)
        on_keyframe(int(keyframes.max()), int(np.sum(environment.success(rollout.state))))
        outcomes = []
        for i, reason in enumerate(problem or reason for problem, reason in zip(problems, reasons, strict=True)):
            done = 0 if problems[i] else int(keyframes[i])
            outcomes.append(
                EpisodeOutcome(
                    success=not reason,
                    reason=reason,
                    keyframes=done,
                    instruction=instructions[i],
                    answers=[texts[k][i] for k in range(done)],
                    views=[last[i]],
                    targets=[targets[k, i] for k in range(done)],
                )
            )
        return outcomes

    def _answers(self, rollout: Rollout, count: int) -> list[object]:
        host = jax.tree.map(np.asarray, rollout.answers)
        return [jax.tree.map(lambda leaf, k=k: leaf[k], host) for k in range(count)]

    def _instructions(self, state: SimState, first: int) -> list[str]:
        return self._environment.instructions(state, np.arange(first, first + state.qpos.shape[0]))
