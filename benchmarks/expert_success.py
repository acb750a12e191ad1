"""Scripted experts on fresh seeds: at least 98 of 100 a task; no success at reset or after doing nothing (2 minutes).

Usage: python -m benchmarks.expert_success [EPISODES]
"""

import sys

import jax
import jax.numpy as jnp
import numpy as np

from dsvla_jax.command_line import configure_jax
from dsvla_jax.sim.episode import Environment
from dsvla_jax.sim.seeds import episode_keys
from dsvla_jax.sim.tasks import TASKS
from dsvla_jax.types import Action


def run_expert(environment: Environment, keys: jax.Array) -> dict[str, np.ndarray]:
    """Which episodes succeed: by the expert, at reset, and after the arms have been told to stay where they are."""
    start = environment.reset(keys)
    pose, gripper = environment.end_effector(start)
    idle = start
    for _ in range(3):
        idle = environment.execute(idle, Action(pose, gripper))
    plan, state = environment.expert(start), start
    for m in range(plan.pose.shape[1]):
        state = environment.execute(state, Action(plan.pose[:, m], plan.gripper_open[:, m]))
    reached = {"expert": state, "at reset": start, "idle": idle}
    return {name: np.asarray(jnp.asarray(environment.success(end))) for name, end in reached.items()}


def main(episodes: int) -> int:
    configure_jax()
    short = False
    for name in TASKS:
        # The validation stream: neither demonstrations nor evaluations use it.
        outcome = run_expert(Environment(name), episode_keys(0, "validation", name, 0, episodes))
        counts = {key: int(value.sum()) for key, value in outcome.items()}
        short |= counts["expert"] < 0.98 * episodes or counts["at reset"] > 0 or counts["idle"] > 0
        print(f"{name:24}" + "".join(f"  {key} {count}/{episodes}" for key, count in counts.items()), flush=True)
    return int(short)


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]) if len(sys.argv) > 1 else 100))
