"""A keyframe in C costs <= 1.3x a bare mujoco.rollout of as many steps; MJX throughput by batch (15 minutes).

Usage: python -m benchmarks.keyframe_speed [--light lamp_on] [--heavy put_rubbish_in_bin] [--mjx-batches 1 8 64 256]
"""

import dataclasses
import functools
import sys
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import mujoco.rollout
import numpy as np
import tyro

from dsvla_jax.command_line import configure_jax, fail_with_message
from dsvla_jax.sim import controller
from dsvla_jax.sim.controller import KEYFRAME_STEPS
from dsvla_jax.sim.environment import Environment
from dsvla_jax.sim.seeds import episode_keys
from dsvla_jax.types import Action

BATCH, REPEATS, LIMIT = 25, 15, 1.3


@dataclasses.dataclass(frozen=True)
class Options:
    """The tasks to time."""

    light: str = "lamp_on"
    heavy: str = "put_rubbish_in_bin"
    mjx_batches: tuple[int, ...] = (1, 8, 64, 256)
    """Empty: only C MuJoCo."""


def fastest(*functions: Callable[[], Any], repeats: int = REPEATS) -> list[float]:
    """Seconds of the fastest call of each function, after a first; called by turns, so that they see one load."""
    times = [[] for _ in functions]
    for _ in range(1 + repeats):
        for function, taken in zip(functions, times, strict=True):
            start = time.perf_counter()
            jax.block_until_ready(function())
            taken.append(time.perf_counter() - start)
    return [min(taken[1:]) for taken in times]


def first_action(environment: Environment, state: Any) -> Action:
    """The first keyframe of the expert."""
    return jax.tree.map(lambda x: x[:, 0], environment.expert(state))


def c_ratio(name: str) -> float:
    """A whole keyframe (plan, steps, judgement, geometry, attachment) over the bare steps of the same model."""
    environment = Environment(name)
    state = environment.reset(episode_keys(0, "validation", name, 0, BATCH))
    action, model = first_action(environment, state), environment.scene.mj_model
    rollout = mujoco.rollout.Rollout(nthread=2)
    data = [mujoco.MjData(model) for _ in range(2)]
    start = np.concatenate([np.zeros((BATCH, 1)), state.qpos, state.qvel], axis=1, dtype=np.float64)
    plans = jax.vmap(functools.partial(controller.plan, arms=environment.scene.arms))(state.ctrl, action)
    controls = np.asarray(plans.controls, np.float64)  # the same motion, so that contacts cost the same
    models = [model] * BATCH
    bare, ours = fastest(
        lambda: rollout.rollout(models, data, start, controls), lambda: environment.step(state, action)
    )
    print(
        f"{name}: {BATCH} keyframes of {KEYFRAME_STEPS} steps: {1e3 * ours:.0f} ms, bare rollout {1e3 * bare:.0f} ms, "
        f"ratio {ours / bare:.2f} (at most {LIMIT})",
        flush=True,
    )
    return ours / bare


def mjx_throughput(name: str, batches: tuple[int, ...]) -> None:
    """Physics steps a second of whole keyframes in MJX."""
    environment = Environment(name, physics="mjx")
    for batch in batches:
        start = time.perf_counter()
        state = environment.reset(episode_keys(0, "validation", name, 0, batch))
        jax.block_until_ready(state)
        compiled = time.perf_counter() - start
        action = jax.tree.map(jnp.asarray, first_action(environment, state))
        (seconds,) = fastest(lambda state=state, action=action: environment.step(state, action), repeats=2)
        rate = batch * KEYFRAME_STEPS / seconds
        print(f"{name} in MJX, batch {batch:4}: {rate:8.0f} steps/s, first call {compiled:.0f} s", flush=True)


def main(options: Options) -> int:
    configure_jax("mjx")
    ratios = [c_ratio(name) for name in (options.light, options.heavy)]
    for name in (options.light, options.heavy) if options.mjx_batches else ():
        mjx_throughput(name, options.mjx_batches)
    return int(max(ratios) > LIMIT)


if __name__ == "__main__":
    with fail_with_message():
        sys.exit(main(tyro.cli(Options, description=__doc__)))
