"""A robot's loop around a policy server: python examples/robot_client.py [--task lamp_on] [--dry-run]

Start a server first: python -m dsvla_jax.serving RUN. For your own robot write a class with `observe` and `move`. With
--dry-run nothing moves: each keyframe is checked and printed.
"""

import dataclasses
import sys
from pathlib import Path
from typing import Any, Literal, Protocol

import jax
import numpy as np
import tyro

# In a fresh clone nothing is installed, and a script's own folder is the only one that Python searches.
sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from dsvla_jax.command_line import configure_jax, fail_with_message
from dsvla_jax.errors import UserError
from dsvla_jax.observation_checks import MAX_DEPTH
from dsvla_jax.perception.simulator import keypoint_source
from dsvla_jax.serving.client import PolicyClient
from dsvla_jax.sim.environment import Environment
from dsvla_jax.sim.seeds import episode_keys
from dsvla_jax.sim.tasks import get_task, select_tasks
from dsvla_jax.types import Action, split_cameras


class Robot(Protocol):
    """What the loop asks of a robot; docs/serving.md has the fields of an observation."""

    def observe(self) -> dict[str, Any]:
        """The pictures with their cameras, the arms' poses and grippers, and keypoints if they are known."""
        ...

    def move(self, pose: np.ndarray, gripper_open: np.ndarray) -> None:
        """Moves the end-effectors to pose (A, 7), world frame, then the grippers: (A,), 1 open, 0 closed."""
        ...

    def done(self) -> bool:
        """Whether the task is finished."""
        ...


class RemotePolicy(Protocol):
    """A client of a policy server: a `PolicyClient`, or openpi-client's `WebsocketClientPolicy`."""

    def infer(self, observation: dict[str, Any], /) -> dict[str, Any]:
        """The reply to an observation; docs/serving.md has the fields of both."""
        ...


class SimulatedRobot:
    """One episode of a task in C MuJoCo, from a start that no demonstration has.

    cameras: names of the simulator's cameras, see `dsvla_jax.sim.cameras`.
    keypoints: those that the policy learned with: found in the first picture with the simulator's masks
        (segmentation), the task's own (oracle), or none.
    """

    def __init__(
        self,
        task: str,
        image_size: int,
        seed: int,
        keypoints: Literal["segmentation", "oracle", "none"],
        cameras: tuple[str, ...] = ("front",),
    ) -> None:
        self.environment = Environment(task, image_size=image_size, cameras=cameras)
        self._state = self.environment.reset(episode_keys(0, "eval", task, seed, 1))
        self.prompt = self.environment.instructions(self._state, seed)[0]
        self._kind, self._find = keypoints, None
        if keypoints == "segmentation":
            make = keypoint_source(keypoints, self.environment)
            self._find = make and make(self._state)
        self._own = np.asarray(self.environment.keypoints(self._state))[0]

    def observe(self) -> dict[str, Any]:
        """See `Robot`. Raises UserError if an object is not seen."""
        seen = self.environment.observe(self._state)
        one = jax.tree.map(lambda leaf: np.asarray(leaf)[0], seen)
        # The fields of a single camera have no camera axis.
        pictures = one.pictures if len(one.pictures.rgb) > 1 else split_cameras(one.pictures)[0]
        observation = {
            "rgb": pictures.rgb,
            # As in the demonstrations, what is farther than a depth camera sees has no reading.
            "depth": np.where(pictures.depth <= MAX_DEPTH, pictures.depth, 0),
            "intrinsics": pictures.camera.intrinsics,
            "world_from_camera": pictures.camera.world_from_camera,
            "pose": one.robot.pose,
            "gripper_open": one.robot.gripper_open,
        }
        if self._find is not None:
            points, (problem,) = self._find(self._state, seen)
            if problem:
                raise UserError(problem)
            return {**observation, "keypoints": points[0]}
        return observation if self._kind == "none" else {**observation, "keypoints": self._own}

    def move(self, pose: np.ndarray, gripper_open: np.ndarray) -> None:
        """See `Robot`."""
        action = Action(pose=np.asarray(pose)[None], gripper_open=np.asarray(gripper_open)[None])  # type: ignore[arg-type]
        self._state = self.environment.step(self._state, action)

    def done(self) -> bool:
        """See `Robot`."""
        return bool(np.asarray(self.environment.success(self._state))[0])


def _listed(numbers: np.ndarray, digits: int) -> str:
    return ", ".join(f"{number:.{digits}f}" for number in numbers)


class DryRun:
    """Another robot's eyes, but no motion: says what it would do, and complains where that is far or out of bounds."""

    def __init__(self, robot: Robot, low: list[float], high: list[float], longest_move: float) -> None:
        self._robot, self._low, self._high, self._longest = robot, np.array(low), np.array(high), longest_move

    def observe(self) -> dict[str, Any]:
        """See `Robot`."""
        self._seen = self._robot.observe()
        return self._seen

    def move(self, pose: np.ndarray, gripper_open: np.ndarray) -> None:
        """Prints each arm's next keyframe."""
        for arm, (target, gripper, now) in enumerate(zip(pose, gripper_open, self._seen["pose"], strict=True)):
            distance = float(np.linalg.norm(target[:3] - now[:3]))
            inside = bool(np.all((target[:3] >= self._low) & (target[:3] <= self._high)))
            print(
                f"  arm {arm}: to {_listed(target[:3], 3)} m, {distance:.2f} m away, "
                f"quaternion {_listed(target[3:], 2)}, then gripper {'open' if gripper > 0.5 else 'closed'}"
                + ("" if inside else "  OUTSIDE THE WORKSPACE")
                + ("" if distance <= self._longest else f"  MORE THAN {self._longest} m AT ONCE")
            )

    def done(self) -> bool:
        """Never: nothing moves."""
        return False


def run_episode(policy: RemotePolicy, robot: Robot, prompt: str, keyframes: int) -> bool:
    """Asks and moves until the robot is done; returns whether it is."""
    for step in range(keyframes):
        reply = policy.infer({**robot.observe(), "prompt": prompt, "reset": step == 0})
        actions = reply["actions"][0].reshape(-1, 8)
        print(f"{step + 1}: {reply['text']}  ({reply['server_timing']['infer_ms']:.0f} ms)")
        robot.move(actions[:, :7], actions[:, 7])
        if robot.done():
            return True
    return False


def simulated_robot(metadata: dict[str, Any], task: str, seed: int) -> SimulatedRobot:
    """The robot that sends what the server's policy learned from. Raises UserError if the simulator has none."""
    (task,) = select_tasks((task,))
    learned, arms = metadata["learned_from"] or {}, get_task(task).num_arms
    if learned and learned["source"] != "simulator" and task not in learned["tasks"]:
        raise UserError(
            f"{metadata['name']} learned from {learned['source']} ({', '.join(learned['tasks'][:5])}), not in the "
            "simulator: write a class with `observe` and `move` for your own robot, as SimulatedRobot in this file"
        )
    if arms not in metadata["arms"]:
        known = " or ".join(map(str, metadata["arms"]))
        raise UserError(f"--task: {task} is for {arms} arm(s), the server's policy for {known}; choose another task")
    squares = [height for height, width in metadata["image_sizes"] if height == width]
    if not squares:
        raise UserError(
            f"the simulator's pictures are square, and the server takes {metadata['image_sizes']} only; start it with "
            "--image-size 96x96 besides"
        )
    keypoints = learned.get("keypoints", "oracle" if metadata["needs_keypoints"] else "none")
    only = learned["camera"] if learned.get("source") == "simulator" and "camera" in learned else "front"
    cameras = tuple(metadata.get("cameras", [only]))
    return SimulatedRobot(task, squares[0], seed, "oracle" if keypoints == "recorded" else keypoints, cameras)


@dataclasses.dataclass(frozen=True)
class Options:
    """Which server, and which robot."""

    host: str = "127.0.0.1"
    """The server's machine."""
    port: int = 8000
    """The server's TCP port."""
    token: str | None = None
    """What the server's --token-file holds, if it has one."""
    task: str = "lamp_on"
    """The simulated robot's task."""
    seed: int = 0
    """The number of the episode."""
    keyframes: int = 10
    """After which an episode is over."""
    timeout: float = 60.0
    """Seconds to connect, and for each reply."""
    dry_run: bool = False
    """Only say what would be done."""
    longest_move: float = 0.8
    """Metres; a dry run complains about longer ones."""


def main(options: Options) -> int:
    """Runs one episode; returns 0 for success and for a dry run, else 1."""
    if options.keyframes < 1 or options.seed < 0 or not options.longest_move > 0:
        raise UserError(
            "--keyframes: expected at least 1, --seed at least 0, --longest-move more than 0; got "
            f"{options.keyframes}, {options.seed}, {options.longest_move}"
        )
    with PolicyClient(options.host, options.port, options.token, options.timeout) as policy:
        robot = simulated = simulated_robot(policy.metadata, options.task, options.seed)
        if options.dry_run:
            low, high = policy.metadata["workspace_low"], policy.metadata["workspace_high"]
            robot = DryRun(simulated, low, high, options.longest_move)
        print(simulated.prompt)
        success = run_episode(policy, robot, simulated.prompt, options.keyframes)
    print("dry run: nothing was moved" if options.dry_run else "success" if success else "no success")
    return int(not success and not options.dry_run)


if __name__ == "__main__":
    with fail_with_message():
        parsed = tyro.cli(Options, description=__doc__)
        configure_jax()
        sys.exit(main(parsed))
