"""Simulation on the device: the closed loop in MJX, the ray caster, and both against the CPU."""

import hashlib
import pickle
import statistics
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import dsvla_jax.policy
from benchmarks._accelerator.sections import Job
from benchmarks._accelerator.tiny import tiny_run
from benchmarks._timing import call, timed
from benchmarks.device_loop import first_keypoints
from benchmarks.mjx_agreement import outcomes
from configs import get_config
from dsvla_jax.evaluation.device_loop import DeviceLoop
from dsvla_jax.experiment import Experiment, load_experiment
from dsvla_jax.model.vla import initialize
from dsvla_jax.policies.interface import Policy
from dsvla_jax.policies.three_ds_vla import TextPolicy
from dsvla_jax.sim.environment import Environment
from dsvla_jax.sim.physics import SimState
from dsvla_jax.sim.seeds import episode_keys
from dsvla_jax.suite_vocabulary import suite_tokenizer

# Different starts; larger batches repeat them.
STARTS = 64
# The rate of a rollout that takes minutes is not measured twice.
ROLLOUT_SECONDS = 20.0
EPISODE_TASK = "lamp_on"


def lamp_on(job: Job) -> None:
    """The device loop of a task whose expert has few keyframes."""
    device_loop(job, "lamp_on")


def stack_blocks(job: Job) -> None:
    """The device loop of a task with many bodies and keyframes."""
    device_loop(job, "stack_blocks")


def policy_to_run(job: Job) -> tuple[Policy, Experiment, bool]:
    """What section `tiny` has trained, with its experiment, and True; without it a random policy of that size."""
    run = tiny_run(job.folder)
    if (run / "metrics.jsonl").exists():
        return dsvla_jax.policy.load_policy(run), load_experiment(run / "config.json"), True
    experiment = get_config("tiny")
    variables = initialize(experiment.model, jax.random.key(0))
    return TextPolicy(experiment.policy, variables, suite_tokenizer()), experiment, False


def starts(task: str, image_size: int, split: str, count: int) -> SimState:
    """``count`` reset states. C MuJoCo settles them, which spares a program of MJX."""
    environment = Environment(task, image_size=image_size)
    return jax.tree.map(jnp.asarray, environment.reset(episode_keys(0, split, task, 0, count)))


def repeated(tree: Any, count: int) -> Any:
    """A tree of arrays with a leading axis, whose rows are repeated until there are ``count``."""
    return jax.tree.map(lambda x: jnp.asarray(np.resize(np.asarray(x), (count, *np.shape(x)[1:]))), tree)


def device_loop(job: Job, task: str) -> None:
    """Keyframes and episodes a second of the closed loop on the device, by how many run side by side."""
    policy, experiment, trained = policy_to_run(job)
    job.note(policy="trained" if trained else "random")
    environment = Environment(task, "mjx", image_size=experiment.data.image_size)
    limit = min(2 * environment.expert_keyframes, job.sizes.keyframes)
    job.note(keyframes_limit=limit)
    state = starts(task, experiment.data.image_size, "eval", min(STARTS, max(job.sizes.episodes)))
    keypoints = first_keypoints(environment, state, experiment.keypoints)
    rollouts = {
        count: partial(DeviceLoop(environment, policy, limit).rollout, *repeated((state, keypoints), count))
        for count in job.sizes.episodes
    }
    # All at once, because their compiling takes far longer than they do.
    with ThreadPoolExecutor(len(rollouts)) as pool:
        _, seconds = call(lambda: [one.result() for one in [pool.submit(rollout) for rollout in rollouts.values()]])
    job.note(compile_and_first_seconds=seconds)
    for count, rollout in rollouts.items():
        runs = [call(rollout)]
        while len(runs) < job.sizes.rollouts and sum(took for _, took in runs) < ROLLOUT_SECONDS:
            runs.append(call(rollout))
        result, times = runs[-1][0], [took for _, took in runs]
        median = statistics.median(times)
        executed = int(np.asarray(result.keyframes).sum())
        # Episodes that are over are stepped on until the last one is.
        stepped = count * int(np.asarray(result.keyframes).max())
        figures = {
            "seconds": median,
            "fastest": min(times),
            "slowest": max(times),
            "repeats": len(times),
            "episodes_per_second": count / median,
            "keyframes_per_second": executed / median,
            "stepped_keyframes_per_second": stepped / median,
            "success": float(np.asarray(result.state.verdict.succeeded).mean()),
            "diverged": int(np.asarray(result.state.diverged).sum()),
        }
        job.note(**{f"episodes {count}": figures})


def render(job: Job) -> None:
    """Frames a second of colour, depth and segmentation by their size."""
    for task in job.sizes.render_tasks:
        state = repeated(starts(task, 96, "validation", min(STARTS, job.sizes.frames)), job.sizes.frames)
        for pixels in job.sizes.pixels:
            environment = Environment(task, image_size=pixels)
            _, timing = timed(partial(environment.render, state), job.sizes.repeats, ROLLOUT_SECONDS / 4)
            figures = {**timing.figures(), "frames_per_second": job.sizes.frames / timing.median}
            job.note(**{f"{task} {pixels} px": figures})


def equal_pictures(job: Job) -> None:
    """Pictures of the same states as the CPU makes them: their hash, and where that differs by how much."""
    expected = pickle.loads(job.prepared("pictures").read_bytes())
    pictures = {}
    for task, one in expected["tasks"].items():
        environment = Environment(task, image_size=expected["pixels"])
        pictures[task] = [np.asarray(x) for x in environment.render(jax.tree.map(jnp.asarray, one["state"]))]
    job.note(**compare_pictures({task: one["pictures"] for task, one in expected["tasks"].items()}, pictures))


def compare_pictures(expected: dict[str, Any], found: dict[str, Any]) -> dict[str, Any]:
    """Figures of two sets of (rgb, depth, segmentation) by task.

    A pixel is equal if all of its colours are. Depths are compared where both see the same geom.
    """
    hashes = [digest([pictures[task][0] for task in expected]) for pictures in (expected, found)]
    rgb, depth, geoms = (
        [np.concatenate([pictures[task][kind].reshape(-1, *pictures[task][kind].shape[3:]) for task in expected])
         for pictures in (expected, found)]
        for kind in range(3)
    )  # fmt: skip
    colour = np.abs(rgb[0].astype(np.int16) - rgb[1].astype(np.int16)).max(axis=-1)
    same = (geoms[0] == geoms[1]) & (depth[0] > 0) & (depth[1] > 0)
    return {
        "pictures": sum(len(one[0]) for one in expected.values()),
        "equal": hashes[0] == hashes[1],
        "sha256_cpu": hashes[0],
        "sha256_device": hashes[1],
        "equal_pixels_share": float((colour == 0).mean()),
        "within_one_share": float((colour <= 1).mean()),
        "largest_colour_difference": int(colour.max()),
        "same_geom_share": float((geoms[0] == geoms[1]).mean()),
        "largest_depth_difference": float(np.abs(depth[0] - depth[1])[same].max(initial=0.0)),
    }


def digest(arrays: list[np.ndarray]) -> str:
    """SHA-256 of arrays, one after the other."""
    total = hashlib.sha256()
    for array in arrays:
        total.update(np.ascontiguousarray(array).tobytes())
    return total.hexdigest()


def equal_episodes(job: Job) -> None:
    """Outcomes of the same plans from the same states in MJX, against MJX and C MuJoCo on the CPU."""
    expected = pickle.loads(job.prepared("episodes").read_bytes())
    environment = Environment(expected["task"], "mjx")
    start, plan = jax.tree.map(jnp.asarray, (expected["start"], expected["plan"]))
    succeeded, timing = timed(lambda: outcomes(environment, start, plan), 1)
    cpu, reference = expected["mjx"], expected["mujoco"]
    job.note(
        **timing.figures(),
        episodes=len(cpu),
        agree=int((succeeded == cpu).sum()),
        agree_with_c_mujoco=int((succeeded == reference).sum()),
        cpu_agrees_with_c_mujoco=int((cpu == reference).sum()),
        succeed_device=succeeded.astype(int).tolist(),
        succeed_cpu=cpu.astype(int).tolist(),
        succeed_c_mujoco=reference.astype(int).tolist(),
    )
