"""A policy server in a process of its own, and simulated robots' questions for it: for the benchmarks of serving."""

import contextlib
import dataclasses
import re
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np

import dsvla_jax.policy
from dsvla_jax.errors import UserError
from dsvla_jax.experiment import load_experiment
from dsvla_jax.serving.batching import Question, answer_batch
from dsvla_jax.sim.environment import Environment
from dsvla_jax.sim.seeds import episode_keys
from dsvla_jax.sim.tasks import get_task, select_tasks
from dsvla_jax.types import split_cameras


@contextlib.contextmanager
def server_process(run: Path, *flags: str) -> Iterator[tuple[int, int]]:
    """Starts `python -m dsvla_jax.serving RUN` on a free port. Yields port and process id once it is ready."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    process = subprocess.Popen([sys.executable, "-m", "dsvla_jax.serving", str(run), "--port", str(port), *flags])
    try:
        while get(port, "/healthz")[0] != 200:
            if process.poll() is not None:
                raise UserError(f"{run}: the server ended before it was ready; its message is above")
            time.sleep(0.5)
        yield port, process.pid
    finally:
        process.terminate()
        process.wait()


def get(port: int, path: str) -> tuple[int, str]:
    """Status and text of a page; status 0 where nobody listens."""
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}{path}", timeout=30) as response:
            return response.status, response.read().decode()
    except urllib.error.HTTPError as error:
        return error.code, ""
    except OSError:
        return 0, ""


def resident_megabytes(pid: int) -> float:
    """Memory that a process holds (Linux)."""
    (kilobytes,) = re.findall(r"VmRSS:\s+(\d+)", Path(f"/proc/{pid}/status").read_text())
    return int(kilobytes) / 1024


@dataclasses.dataclass(frozen=True)
class Known:
    """A robot's request at the start of an episode, and what the policy answers to it by itself."""

    request: dict[str, Any]
    text: str


def known_answers(run: Path, episodes: int) -> list[Known]:
    """The starts of so many simulated episodes of each of the run's tasks for one arm, answered without a server."""
    policy, data = dsvla_jax.policy.load_policy(run), load_experiment(run / "config.json").data
    known = []
    for name in select_tasks(data.tasks):
        if get_task(name).num_arms != 1:
            continue
        environment = Environment(name, image_size=data.image_size)
        state = environment.reset(episode_keys(0, "validation", name, 0, episodes))
        seen = jax.tree.map(np.asarray, environment.observe(state))
        keypoints = np.asarray(environment.keypoints(state))
        for i, instruction in enumerate(environment.instructions(state, np.arange(episodes))):
            one = jax.tree.map(lambda x, i=i: x[i], seen)
            (picture,) = split_cameras(one.pictures)
            (answer,) = answer_batch(policy, [Question(instruction, one, keypoints[i, :, 0])])
            request = {
                "prompt": instruction,
                "rgb": picture.rgb,
                "depth": picture.depth,
                "intrinsics": picture.camera.intrinsics,
                "world_from_camera": picture.camera.world_from_camera,
                "pose": one.robot.pose,
                "gripper_open": one.robot.gripper_open,
                "keypoints": keypoints[i, :, :1],
                "reset": True,
            }
            known.append(Known(request, answer.text))
    return known
