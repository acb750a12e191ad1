"""The closed loop on the device gives the host loop's episodes on two tasks; episodes/s of both by batch (20 minutes).

Usage: python -m benchmarks.device_loop [RUN] [--tasks lamp_on put_rubbish_in_bin] [--batches 4 16]

Both step MJX. An episode agrees if its outcome, its number of keyframes and every answer are the same. The same start
is run four times: rates are of the quickest of the last three; the first one's seconds, most of them XLA's, are printed
beside them.
"""

import dataclasses
import sys
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import tyro

import dsvla_jax.policy
from benchmarks._timing import timed
from dsvla_jax.command_line import configure_jax, fail_with_message
from dsvla_jax.evaluation.device_loop import DeviceLoop, Rollout
from dsvla_jax.evaluation.loop import run_episodes
from dsvla_jax.evaluation.outcome import EpisodeOutcome
from dsvla_jax.experiment import load_experiment
from dsvla_jax.perception.simulator import Keypoints, keypoint_source
from dsvla_jax.policies.interface import DevicePolicy
from dsvla_jax.sim.environment import Environment
from dsvla_jax.sim.physics import SimState
from dsvla_jax.sim.seeds import episode_keys
from dsvla_jax.types import Array

REPEATS = 3


@dataclasses.dataclass(frozen=True)
class Options:
    """Which run, on which tasks, with how many episodes side by side."""

    run: tyro.conf.Positional[Path] = Path("runs/tiny")
    tasks: tuple[str, ...] = ("lamp_on", "put_rubbish_in_bin")
    batches: tuple[int, ...] = (4, 16)


def agreeing(policy: DevicePolicy, endings: list[EpisodeOutcome], rollout: Rollout) -> int:
    """Episodes that are the same in both."""
    keyframes, succeeded = np.asarray(rollout.keyframes), np.asarray(rollout.state.verdict.succeeded)
    texts = [policy.texts(jax.tree.map(lambda x, k=k: x[k], rollout.answers)) for k in range(int(keyframes.max()))]
    return sum(
        ending.success == succeeded[i]
        and ending.keyframes == keyframes[i]
        and ending.answers == [texts[k][i] for k in range(keyframes[i])]
        for i, ending in enumerate(endings)
    )


def first_keypoints(environment: Environment, state: SimState, kind: Keypoints) -> Array | None:
    """The keypoints (B, A, K, 3) that the whole episodes have; None for the task's own."""
    find = keypoint_source(kind, environment)
    return jnp.asarray(find(state)(state, environment.observe(state))[0]) if find else None


def main(options: Options) -> int:
    policy, experiment = dsvla_jax.policy.load_policy(options.run), load_experiment(options.run / "config.json")
    different = 0
    for task in options.tasks:
        environment = Environment(task, "mjx", image_size=experiment.data.image_size)
        on_device = DeviceLoop(environment, policy)
        asked = policy.on_device(environment.num_arms, environment.task.all_instructions())
        for batch in options.batches:
            state = environment.reset(episode_keys(0, "eval", task, 0, batch))
            keypoints = first_keypoints(environment, state, experiment.keypoints)
            find = keypoint_source(experiment.keypoints, environment)
            from_host = partial(run_episodes, environment, policy.act, state, find_keypoints=find and find(state))
            endings, host_times = timed(from_host, REPEATS)
            rollout, device_times = timed(partial(on_device.rollout, state, keypoints), REPEATS)
            device, host = min(device_times.later), min(host_times.later)
            same = agreeing(asked, endings, rollout)
            different += batch - same
            print(
                f"{task} x {batch}: {same} of {batch} episodes agree, {sum(e.success for e in endings)} succeed; "
                f"{batch / device:.2f} episodes/s on the device, {batch / host:.2f} from the host "
                f"(the first time: {device_times.first:.0f} s and {host_times.first:.0f} s)",
                flush=True,
            )
    return int(different > 0)


if __name__ == "__main__":
    with fail_with_message():
        parsed = tyro.cli(Options, description=__doc__)
        configure_jax("mjx")
        sys.exit(main(parsed))
