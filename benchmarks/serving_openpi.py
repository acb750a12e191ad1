"""The published openpi-client package drives simulated episodes of a run's tasks through the server (3 minutes).

    pip install --no-deps --target CLIENT openpi-client==0.1.2
    PYTHONPATH=CLIENT python -m benchmarks.serving_openpi [RUN] [--episodes 4]

Without its dependencies, because it pins NumPy 1; it runs with NumPy 2 all the same. Exits with 77 where it is missing,
and with 1 unless an episode of every task succeeds, and as many as without a server.
"""

import dataclasses
import sys
from pathlib import Path

import numpy as np
import tyro

import dsvla_jax.policy
from benchmarks._server import server_process
from dsvla_jax.command_line import configure_jax, fail_with_message
from dsvla_jax.evaluation.loop import run_episodes
from dsvla_jax.experiment import load_experiment
from dsvla_jax.perception.simulator import keypoint_source
from dsvla_jax.sim.environment import Environment
from dsvla_jax.sim.seeds import episode_keys
from dsvla_jax.sim.tasks import select_tasks
from examples.robot_client import run_episode, simulated_robot

NO_CLIENT = 77


@dataclasses.dataclass(frozen=True)
class Options:
    """Which run, on how many episodes a task."""

    run: tyro.conf.Positional[Path] = Path("runs/tiny")
    episodes: int = 4


def main(options: Options) -> int:
    try:
        from openpi_client.websocket_client_policy import WebsocketClientPolicy  # type: ignore[import-not-found]
    except ModuleNotFoundError as error:
        print(f"no openpi-client ({error}); see the top of {__file__}", file=sys.stderr)
        return NO_CLIENT
    experiment, enough = load_experiment(options.run / "config.json"), True
    data = experiment.data
    policy = dsvla_jax.policy.load_policy(options.run)
    with server_process(options.run, "--batch", "1") as (port, _):
        for name in select_tasks(data.tasks):
            remote = []
            for seed in range(options.episodes):
                client = WebsocketClientPolicy("127.0.0.1", port)
                robot = simulated_robot(client.get_server_metadata(), name, seed)
                limit = 2 * robot.environment.expert_keyframes
                remote.append(run_episode(client, robot, robot.prompt, limit))
                client._ws.close()
            environment = Environment(name, image_size=data.image_size)
            state = environment.reset(episode_keys(0, "eval", name, 0, options.episodes))
            make = keypoint_source(experiment.keypoints, environment)
            endings = run_episodes(environment, policy.act, state, find_keypoints=make and make(state))
            local = [ending.success for ending in endings]
            print(f"{name}: {sum(remote)} of {options.episodes} through the server, {sum(local)} without", flush=True)
            enough &= any(remote) and bool(np.array_equal(remote, local))
    return int(not enough)


if __name__ == "__main__":
    with fail_with_message():
        parsed = tyro.cli(Options, description=__doc__)
        configure_jax()
        sys.exit(main(parsed))
