"""Hostile actions and 10,000 steps of noise leave no NaN in any task; a diverged episode fails alone (6 minutes).

Usage: python -m benchmarks.robustness [--tasks lamp_on ...] [--keyframes 67] [--physics mjx]
"""

import dataclasses
import sys
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from dsvla_jax.command_line import configure_jax, fail_with_message
from dsvla_jax.evaluation.outcome import failure_reasons
from dsvla_jax.sim.environment import Environment
from dsvla_jax.sim.physics import SimState
from dsvla_jax.sim.seeds import episode_keys
from dsvla_jax.sim.tasks import select_tasks
from dsvla_jax.types import TABLE_HEIGHT, Action

BATCH = 4


@dataclasses.dataclass(frozen=True)
class Options:
    """What to torment, and for how long."""

    tasks: tuple[str, ...] = ("all",)
    keyframes: int = 67
    """Random keyframes, of 150 physics steps each."""
    physics: Literal["mujoco", "mjx"] = "mujoco"


def random_action(rng: np.random.Generator, arms: int) -> Action:
    """Keyframes all over the table, into it and out of reach, every third of them with the gripper straight down."""
    low, high = [-0.4, -0.5, TABLE_HEIGHT - 0.05], [0.6, 0.5, TABLE_HEIGHT + 0.6]
    turns = rng.normal(size=(BATCH, arms, 4))
    down = np.broadcast_to([0.0, 1.0, 0.0, 0.0], turns.shape)
    turns = np.where(rng.random((BATCH, arms, 1)) < 0.7, down, turns / np.linalg.norm(turns, axis=-1, keepdims=True))
    pose = np.concatenate([rng.uniform(low, high, (BATCH, arms, 3)), turns], axis=-1)
    return Action(jnp.asarray(pose, jnp.float32), jnp.asarray(rng.random((BATCH, arms)) < 0.5, jnp.float32))


def hostile_actions(environment: Environment, state: SimState) -> dict[str, Action]:
    """What no policy should say."""
    pose, gripper = environment.end_effector(state)
    nothing = pose.at[..., :3].set(jnp.array([0.2, 0.0, TABLE_HEIGHT + 0.4])).at[..., 3:].set(jnp.array([0, 1.0, 0, 0]))
    return {
        "NaN": Action(pose * jnp.nan, gripper),
        "infinite": Action(pose.at[..., 0].set(jnp.inf), gripper),
        "no rotation": Action(pose.at[..., 3:].set(0.0), gripper),
        "NaN gripper": Action(pose, gripper * jnp.nan),
        "unreachable": Action(pose.at[..., 0].add(5.0), gripper),
        "a grasp of nothing": Action(nothing, jnp.zeros_like(gripper)),
    }


def non_finite(state: SimState) -> list[str]:
    """The fields of the state with a NaN or an infinity."""
    paths = jax.tree_util.tree_leaves_with_path(state)
    return [jax.tree_util.keystr(path) for path, leaf in paths if not np.isfinite(np.asarray(leaf)).all()]


def torment(name: str, keyframes: int, physics: Literal["mujoco", "mjx"] = "mujoco") -> list[str]:
    """What is wrong with the task; nothing is wanted."""
    environment, faults = Environment(name, physics), []
    start = environment.reset(episode_keys(0, "validation", name, 0, BATCH))
    for what, action in hostile_actions(environment, start).items():
        faults += [f"{what}: {field}" for field in non_finite(environment.step(start, action))]

    rng, state = np.random.default_rng(0), start
    for _ in range(keyframes):
        state = environment.step(state, random_action(rng, environment.num_arms))
    faults += [f"noise: {field}" for field in non_finite(state)]

    action = random_action(rng, environment.num_arms)
    broken = start.replace(qvel=jnp.asarray(start.qvel).at[1].set(jnp.nan))
    healthy, hurt = environment.step(start, action), environment.step(broken, action)
    if failure_reasons(environment, hurt)[1] != "the simulation diverged" or np.asarray(hurt.diverged).sum() != 1:
        faults.append("an episode with NaN velocities is not reported as diverged, or not alone")
    others = np.array([0, 2, 3])
    same = jax.tree.map(lambda a, b: np.array_equal(np.asarray(a)[others], np.asarray(b)[others]), healthy, hurt)
    if not all(jax.tree.leaves(same)):
        faults.append("a diverged episode changed its batch-mates")
    return faults


def main(options: Options) -> int:
    configure_jax(options.physics)
    failed = False
    for name in select_tasks(options.tasks):
        faults = torment(name, options.keyframes, options.physics)
        failed |= bool(faults)
        print(f"{name:36} {'; '.join(faults) or 'ok'}", flush=True)
    return int(failed)


if __name__ == "__main__":
    with fail_with_message():
        sys.exit(main(tyro.cli(Options, description=__doc__)))
