"""The closed loop on the device: observe, encode, decode, execute and judge many episodes as one jitted function.

`rollout.run_episodes` is the reference, which asks the policy from the host; both give the same episodes.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from dsvla_jax.encoding.encode import model_inputs
from dsvla_jax.encoding.grammar import build_answer_grammar
from dsvla_jax.encoding.keypoints import active_keypoint, advance_latch
from dsvla_jax.encoding.prompt_table import instruction_tokens, make_prompt_table, write_prompts
from dsvla_jax.encoding.text import Tokenizer
from dsvla_jax.model.decode import GREEDY, Decoding, decode_actions
from dsvla_jax.model.variables import Variables
from dsvla_jax.model.vla import VLA
from dsvla_jax.policy import Policy, PolicyConfig
from dsvla_jax.sim import environment as simulator
from dsvla_jax.sim.environment import Environment
from dsvla_jax.sim.physics import Physics, SimState, jit_with_mjx
from dsvla_jax.types import Array, Text


@struct.dataclass
class Rollout:
    """What became of B episodes of at most L key poses.

    state: the last. integers: int32 (L, B, A, 8), the answers, zero where no key pose was executed any more.
    keyframes: int32 (B,), how many each episode had.
    """

    state: SimState
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
    Raises ValueError for what only `rollout.run_episodes` does: C physics, and answers that are displacements.
    """
    if config.displacement is not None:
        raise ValueError("device_loop: this policy answers with displacements; run it with rollout.run_episodes")
    if not environment.physics.traceable:
        raise ValueError(f"device_loop: expected Environment({environment.task.name!r}, physics='mjx'), not C MuJoCo's")
    encoding, arms = config.encoding, environment.num_arms
    table = make_prompt_table(tokenizer, encoding, arms)
    grammar = build_answer_grammar(tokenizer, arms, encoding.style)
    size = longest_instruction + table.longest

    def turn(
        physics: Physics, variables: Variables, state: SimState, active: Array, text: tuple[Array, Array]
    ) -> tuple[SimState, Array]:
        observation = environment.observe(state)
        robot = observation.robot
        batch = robot.pose.shape[0]
        integers = encoding.codec.encode(robot.pose, robot.gripper_open).reshape(batch, -1)
        if encoding.use_keypoints:
            near = encoding.codec.encode_position(active).reshape(batch, -1)
            integers = jnp.concatenate([integers, near], axis=1)
        prompts = Text(*write_prompts(table, text[0], text[1], integers, size, tokenizer.pad_id))
        inputs = model_inputs(observation.picture, prompts, encoding)
        answer = decode_actions(VLA(config.model), variables, inputs, grammar, decoding, None).integers
        return simulator.step(environment.scene, physics, state, encoding.codec.decode(answer)), answer

    def run(
        physics: Physics, variables: Variables, state: SimState, keypoints: Array, beginnings: Array, lengths: Array
    ) -> Rollout:
        batch = keypoints.shape[0]

        def going_on(carry: tuple) -> Array:
            done, state, _, _ = carry
            return (done < limit) & ~jnp.all(_over(state))

        def step(carry: tuple) -> tuple:
            done, state, latched, rollout = carry
            positions = environment.end_effector(state)[0][..., :3]
            latched = jax.vmap(advance_latch)(latched, positions, keypoints)
            active = jax.vmap(jax.vmap(active_keypoint))(latched, keypoints)
            running = ~_over(state)
            state, answer = turn(physics, variables, state, active, (beginnings, lengths))
            integers = rollout[0].at[done].set(jnp.where(running[:, None, None], answer, 0))
            return done + 1, state, latched, (integers, rollout[1] + running)

        start = (jnp.zeros((limit, batch, arms, 8), jnp.int32), jnp.zeros(batch, jnp.int32))
        latched = jnp.zeros((batch, arms), jnp.int32)
        _, state, _, (integers, keyframes) = jax.lax.while_loop(
            going_on, step, (jnp.int32(0), jax.tree.map(jnp.asarray, state), latched, start)
        )
        return Rollout(state, integers, keyframes)

    return run


def _over(state: SimState) -> Array:
    return state.verdict.succeeded | state.verdict.failed | state.diverged


class DeviceRollout:
    """Runs a policy's episodes of one task on the device; compiled once for each size of a batch.

    environment: with physics "mjx". limit: key poses after which an episode is over; twice the expert's if not given.
    """

    def __init__(self, environment: Environment, policy: Policy, limit: int | None = None):
        self._environment, self._policy = environment, policy
        encoding, task = policy.config.encoding, environment.task
        everything = instruction_tokens(policy.tokenizer, encoding, task.num_arms, task.all_instructions())[0]
        self._longest = everything.shape[1]
        limit = limit or 2 * environment.expert_keyframes
        loop = device_loop(environment, policy.config, policy.tokenizer, limit, self._longest, policy.decoding)
        self._run = jit_with_mjx(loop)

    def __call__(self, state: SimState, keypoints: Array | np.ndarray | None = None) -> Rollout:
        """The episodes of a reset state, each told its task in another way, as `rollout.run_episodes` does.

        keypoints: float32 (B, A, K, 3), those of a `rollout.KeypointSource` for the first frame; the task's own if not
            given.
        """
        instructions = self._environment.instructions(state, np.arange(state.qpos.shape[0]))
        encoding, arms = self._policy.config.encoding, self._environment.num_arms
        beginnings, lengths = instruction_tokens(self._policy.tokenizer, encoding, arms, instructions)
        beginnings = np.pad(beginnings, ((0, 0), (0, self._longest - beginnings.shape[1])))
        keypoints = jnp.asarray(self._environment.keypoints(state) if keypoints is None else keypoints)
        return self._run(self._environment.physics, self._policy.variables, state, keypoints, beginnings, lengths)
