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

from dsvla_jax.encoding.codec import VALUES_PER_ARM
from dsvla_jax.encoding.encode import model_inputs
from dsvla_jax.encoding.grammar import build_answer_grammar
from dsvla_jax.encoding.prompt_table import instruction_tokens, make_prompt_table, write_prompts
from dsvla_jax.encoding.prompts import format_answer
from dsvla_jax.encoding.text import Tokenizer
from dsvla_jax.errors import UserError
from dsvla_jax.evaluation.loop import KeypointSource, policy_step
from dsvla_jax.evaluation.outcome import EpisodeOutcome, failure_reasons, is_over, views_of
from dsvla_jax.model.decode import GREEDY, Decoding, decode_actions
from dsvla_jax.model.variables import Variables
from dsvla_jax.model.vla import VLA
from dsvla_jax.policy import Policy, PolicyConfig
from dsvla_jax.sim import environment as simulator
from dsvla_jax.sim.environment import Environment
from dsvla_jax.sim.physics import Physics, SimState, jit_with_mjx
from dsvla_jax.types import Action, Array, Observation, Text


@struct.dataclass
class Rollout:
    """What became of B episodes of at most L keyframes, on the device."""

    state: SimState
    """The last."""
    integers: Int[Array, "l b a 8"]
    """The answers; zeros after an episode's end."""
    keyframes: Int[Array, " b"]
    """Keyframes that each episode had."""


class _Carry(NamedTuple):
    done: Array
    state: SimState
    latched: Array
    integers: Array
    keyframes: Array


Loop = Callable[[Physics, Variables, SimState, Array, Array, Array], Rollout]


def device_loop(
    environment: Environment,
    config: PolicyConfig,
    tokenizer: Tokenizer,
    limit: int,
    longest_instruction: int,
    decoding: Decoding = GREEDY,
) -> Loop:
    """The pure ``(physics, variables, state, keypoints, beginnings, lengths) -> Rollout`` of an MJX environment.

    keypoints: float32 (B, A, K, 3), of the whole episode. beginnings: (B, P), lengths: (B,), the instructions' tokens,
    see `prompt_table.instruction_tokens`. limit: L. longest_instruction: P. ``decoding`` must not sample.
    Raises ValueError for C physics, and UserError for answers that are displacements: the loop on the host does both.
    """
    if config.displacement is not None:
        raise UserError("loop: this policy answers with displacements; use the loop on the host: --loop host")
    if not environment.physics.traceable:
        raise ValueError(f"device_loop: expected Environment({environment.task.name!r}, physics='mjx'), not C MuJoCo's")
    encoding, arms = config.encoding, environment.num_arms
    table = make_prompt_table(tokenizer, encoding, arms)
    grammar = build_answer_grammar(tokenizer, arms, encoding.style)
    size = longest_instruction + table.longest

    def run(
        physics: Physics, variables: Variables, state: SimState, keypoints: Array, beginnings: Array, lengths: Array
    ) -> Rollout:
        batch = keypoints.shape[0]

        def decide(observation: Observation[Array], active: Array) -> tuple[Action[Array], Array]:
            robot = observation.robot
            integers = encoding.codec.encode(robot.pose, robot.gripper_open).reshape(batch, -1)
            if encoding.use_keypoints:
                near = encoding.codec.encode_position(active).reshape(batch, -1)
                integers = jnp.concatenate([integers, near], axis=1)
            prompts = Text(*write_prompts(table, beginnings, lengths, integers, size, tokenizer.pad_id))
            inputs = model_inputs(observation.pictures, prompts, encoding)
            answer = decode_actions(VLA(config.model), variables, inputs, grammar, decoding, None).integers
            return encoding.codec.decode(answer), answer

        def goes_on(carry: _Carry) -> Array:
            return (carry.done < limit) & ~jnp.all(is_over(carry.state))

        def turn(carry: _Carry) -> _Carry:
            running = ~is_over(carry.state)
            state, latched, _, answer = policy_step(
                carry.state,
                environment.observe(carry.state),
                carry.latched,
                keypoints,
                decide,
                functools.partial(simulator.step, environment.scene, physics),
            )
            integers = carry.integers.at[carry.done].set(jnp.where(running[:, None, None], answer, 0))
            return _Carry(carry.done + 1, state, latched, integers, carry.keyframes + running)

        last = jax.lax.while_loop(
            goes_on,
            turn,
            _Carry(
                done=jnp.int32(0),
                state=jax.tree.map(jnp.asarray, state),
                latched=jnp.zeros((batch, arms), jnp.int32),
                integers=jnp.zeros((limit, batch, arms, VALUES_PER_ARM), jnp.int32),
                keyframes=jnp.zeros(batch, jnp.int32),
            ),
        )
        return Rollout(last.state, last.integers, last.keyframes)

    return run


class DeviceLoop:
    """The loop on the device for a policy and a task; compiled once for each size of a batch. See `RunEpisodes`.

    environment: with physics "mjx". limit: keyframes after which an episode is over; twice the expert's if not given.
    """

    def __init__(self, environment: Environment, policy: Policy, limit: int | None = None) -> None:
        self._environment, self._policy = environment, policy
        encoding, task = policy.config.encoding, environment.task
        everything = instruction_tokens(policy.tokenizer, encoding, task.num_arms, task.all_instructions())[0]
        self._longest = everything.shape[1]
        limit = limit or 2 * environment.expert_keyframes
        loop = device_loop(environment, policy.config, policy.tokenizer, limit, self._longest, policy.decoding)
        self._run = jit_with_mjx(loop)

    def rollout(
        self, state: SimState, keypoints: Float[Array | np.ndarray, "b a k 3"] | None = None, first: int = 0
    ) -> Rollout:
        """Runs the episodes of a reset state, and leaves what became of them on the device.

        keypoints: of the whole episode; the task's own if not given. first: see `loop.run_episodes`.
        """
        instructions = self._instructions(state, first)
        encoding, arms = self._policy.config.encoding, self._environment.num_arms
        beginnings, lengths = instruction_tokens(self._policy.tokenizer, encoding, arms, instructions)
        beginnings = np.pad(beginnings, ((0, 0), (0, self._longest - beginnings.shape[1])))
        keypoints = self._environment.keypoints(state) if keypoints is None else keypoints
        arrays = (jnp.asarray(array) for array in (keypoints, beginnings, lengths))
        return self._run(self._environment.physics, self._policy.variables, state, *arrays)

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
        environment, codec = self._environment, self._policy.codec
        keypoints, problems = np.asarray(environment.keypoints(state)), [""] * state.qpos.shape[0]
        noise = np.broadcast_to(noise, keypoints.shape)
        if find_keypoints is not None:
            keypoints, problems = find_keypoints(state, environment.observe(state))
        keypoints = (keypoints + noise[:, :, : keypoints.shape[2]]).astype(np.float32)
        rollout = self.rollout(state, keypoints, first)
        integers, keyframes = np.asarray(rollout.integers), np.asarray(rollout.keyframes)
        targets = np.asarray(codec.decode(rollout.integers).pose)[..., :3]
        last = views_of(environment.observe(rollout.state))
        style, instructions = self._policy.config.encoding.style, self._instructions(state, first)
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
                    answers=[format_answer(integers[k, i], style) for k in range(done)],
                    views=[last[i]],
                    targets=[targets[k, i] for k in range(done)],
                )
            )
        return outcomes

    def _instructions(self, state: SimState, first: int) -> list[str]:
        return self._environment.instructions(state, np.arange(first, first + state.qpos.shape[0]))
