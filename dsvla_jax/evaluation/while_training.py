"""Closed-loop success while a policy is trained."""

import functools
from collections.abc import Callable

import numpy as np

from dsvla_jax.data_config import DataConfig
from dsvla_jax.evaluation.loop import Act, Stopped, on_host, run_task
from dsvla_jax.perception.simulator import Keypoints, keypoint_source
from dsvla_jax.sim.environment import Environment


def measure_success(
    act: Act,
    data: DataConfig,
    keypoints: Keypoints,
    episodes: int,
    stop: Callable[[], bool],
) -> dict[str, float]:
    """Measures the share of successes of a policy in each task, from seeds that neither training nor eval.py has.

    data: of the run; its tasks, each named, and its cameras are simulated. stop: asked after every keyframe.
    Returns `evaluation/TASK`, and the mean over tasks as `evaluation/success`; nothing if it was stopped.
    """
    rates: dict[str, float] = {}
    for name in data.tasks:
        environment = _environment(name, data.image_size, data.cameras)
        try:
            outcomes = run_task(
                environment,
                on_host(environment, act),
                episodes,
                split="validation",
                seed=data.seed,
                find_keypoints=keypoint_source(keypoints, environment),
                stop=stop,
            )
        except Stopped:
            return {}
        rates[f"evaluation/{name}"] = float(np.mean([outcome.success for outcome in outcomes]))
    return {**rates, "evaluation/success": float(np.mean(list(rates.values())))}


@functools.cache
def _environment(task: str, image_size: int, cameras: tuple[str, ...]) -> Environment:
    """Kept from one evaluation of a run to the next, with what it has compiled."""
    return Environment(task, image_size=image_size, cameras=cameras)
