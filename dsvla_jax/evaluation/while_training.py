"""Closed-loop success while a policy is trained."""

from collections.abc import Callable, Mapping

import numpy as np

from dsvla_jax.evaluation.loop import Act, Stopped, on_host, run_task
from dsvla_jax.perception.simulator import Keypoints, keypoint_source
from dsvla_jax.sim.environment import Environment


def measure_success(
    act: Act,
    environments: Mapping[str, Environment],
    keypoints: Keypoints,
    episodes: int,
    seed: int,
    stop: Callable[[], bool],
) -> dict[str, float]:
    """Measures the share of successes of a policy in each task, from seeds that neither training nor eval.py has.

    environments: by task. stop: asked after every keyframe.
    Returns `evaluation/TASK`, and the mean over tasks as `evaluation/success`; nothing if it was stopped.
    """
    rates: dict[str, float] = {}
    for name, environment in environments.items():
        try:
            outcomes = run_task(
                environment,
                on_host(environment, act),
                episodes,
                split="validation",
                seed=seed,
                find_keypoints=keypoint_source(keypoints, environment),
                stop=stop,
            )
        except Stopped:
            return {}
        rates[f"evaluation/{name}"] = float(np.mean([outcome.success for outcome in outcomes]))
    return {**rates, "evaluation/success": float(np.mean(list(rates.values())))}
