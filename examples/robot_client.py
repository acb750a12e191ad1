"""A robot's loop around a policy server: python examples/robot_client.py [--task lamp_on] [--dry-run]

Start a server first: python -m dsvla_jax.serving RUN. For your own robot write a class with `observe` and `move`. With
--dry-run nothing moves: each key pose is checked and printed.
"""

import dataclasses
import sys
from typing import Any, Protocol

import numpy as np
import tyro

from dsvla_jax.command_line import configure_jax, fail_with_message
from dsvla_jax.serving.client import PolicyClient
from dsvla_jax.sim.episode import Environment
from dsvla_jax.sim.seeds import episode_keys
from dsvla_jax.types import Action


class Robot(Protocol):
    """What the loop asks of a robot; docs/serving.md has the fields of an observation."""

    def observe(self) -> dict[str, Any]:
        """The picture with its camera, the arms' poses and grippers, and keypoints if they are known."""
        ...

    def move(self, pose: np.ndarray, gripper_open: np.ndarray) -> None:
        """Moves the end-effectors to pose (A, 7), world frame, then the grippers: (A,), 1 open, 0 closed."""
        ...

    def done(self) -> bool:
        """Whether the task is finished."""
        ...


class SimulatedRobot:
    """One episode of a task in C MuJoCo, from a start that no demonstration has."""

    def __init__(self, task: str, image_size: int, seed: int):
        self.environment = Environment(task, image_size=image_size)
        self._state = self.environment.reset(episode_keys(0, "eval", task, seed, 1))
        self.prompt = self.environment.instructions(self._state, seed)[0]
        self._keypoints = np.asarray(self.environment.keypoints(self._state))[0]

    def observe(self) -> dict[str, Any]:
        seen = self.environment.observe(self._state)
        return {
            "rgb": np.asarray(seen.rgb)[0],
            "depth": np.asarray(seen.depth)[0],
            "intrinsics": np.asarray(seen.camera.intrinsics)[0],
            "world_from_camera": np.asarray(seen.camera.world_from_camera)[0],
            "pose": np.asarray(seen.pose)[0],
            "gripper_open": np.asarray(seen.gripper_open)[0],
            "keypoints": self._keypoints,
        }

    def move(self, pose: np.ndarray, gripper_open: np.ndarray) -> None:
        action = Action(pose=np.asarray(pose)[None], gripper_open=np.asarray(gripper_open)[None])  # type: ignore[arg-type]
        self._state = self.environment.execute(self._state, action)

    def done(self) -> bool:
        return bool(np.asarray(self.environment.success(self._state))[0])


class DryRun:
    """Another robot's eyes, but no motion: says what it would do, and complains where that is far or out of bounds."""

    def __init__(self, robot: Robot, low: list[float], high: list[float], longest_move: float):
        self._robot, self._low, self._high, self._longest = robot, np.array(low), np.array(high), longest_move

    def observe(self) -> dict[str, Any]:
        self._seen = self._robot.observe()
        return self._seen

    def move(self, pose: np.ndarray, gripper_open: np.ndarray) -> None:
        for arm, (target, gripper, now) in enumerate(zip(pose, gripper_open, self._seen["pose"], strict=True)):
            distance = float(np.linalg.norm(target[:3] - now[:3]))
            inside = bool(np.all((target[:3] >= self._low) & (target[:3] <= self._high)))
            print(
                f"  arm {arm}: to {np.round(target[:3], 3).tolist()} m, {distance:.2f} m away, quaternion "
                f"{np.round(target[3:], 2).tolist()}, then gripper {'open' if gripper > 0.5 else 'closed'}"
                + ("" if inside else "  OUTSIDE THE WORKSPACE")
                + ("" if distance <= self._longest else f"  MORE THAN {self._longest} m AT ONCE")
            )

    def done(self) -> bool:
        return False


def run_episode(policy: Any, robot: Robot, prompt: str, key_poses: int) -> bool:
    """Asks and moves until the robot is done. policy: a `PolicyClient`, or openpi-client's `WebsocketClientPolicy`."""
    for step in range(key_poses):
        reply = policy.infer({**robot.observe(), "prompt": prompt, "reset": step == 0})
        actions = reply["actions"][0].reshape(-1, 8)
        print(f"{step + 1}: {reply['text']}  ({reply['server_timing']['infer_ms']:.0f} ms)")
        robot.move(actions[:, :7], actions[:, 7])
        if robot.done():
            return True
    return False


@dataclasses.dataclass(frozen=True)
class Options:
    """Which server, and which robot."""

    host: str = "127.0.0.1"
    port: int = 8000
    token: str | None = None
    task: str = "lamp_on"
    """The simulated robot's task."""
    seed: int = 0
    key_poses: int = 10
    """After which an episode is over."""
    dry_run: bool = False
    """Only say what would be done."""
    longest_move: float = 0.8
    """Metres; a dry run complains about longer ones."""


def main(options: Options) -> int:
    with PolicyClient(options.host, options.port, options.token) as policy:
        height, _ = policy.metadata["image_sizes"][0]
        robot = simulated = SimulatedRobot(options.task, height, options.seed)
        if options.dry_run:
            low, high = policy.metadata["workspace_low"], policy.metadata["workspace_high"]
            robot = DryRun(simulated, low, high, options.longest_move)
        print(simulated.prompt)
        success = run_episode(policy, robot, simulated.prompt, options.key_poses)
    print("dry run: nothing was moved" if options.dry_run else "success" if success else "no success")
    return int(not success and not options.dry_run)


if __name__ == "__main__":
    with fail_with_message():
        parsed = tyro.cli(Options, description=__doc__)
        configure_jax()
        sys.exit(main(parsed))
