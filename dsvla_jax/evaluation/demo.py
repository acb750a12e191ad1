"""Show one episode of a run as an HTML page: python -m dsvla_jax.evaluation.demo RUN [--task lamp_on] [--out demo.html]

For each keyframe: the pictures with the cloud's 3D tokens and the patches they are aligned with, the keypoints, the
prompt, the answer with how probable each number was, and where the arm went.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import tyro

import dsvla_jax.policy
from dsvla_jax.command_line import configure_jax, fail_with_message, parse_options
from dsvla_jax.encoding.config import EncodingConfig
from dsvla_jax.encoding.encode import build_prompt, cloud_tokens
from dsvla_jax.encoding.prompts import parse_answer
from dsvla_jax.errors import UserError
from dsvla_jax.evaluation.loop import run_episodes
from dsvla_jax.evaluation.pages import png_data, write_html
from dsvla_jax.evaluation.pictures import mark_targets
from dsvla_jax.evaluation.results import require_writable
from dsvla_jax.experiment import load_experiment, require_simulated
from dsvla_jax.geometry.cameras import project
from dsvla_jax.perception.simulator import keypoint_source
from dsvla_jax.policies.interface import Decision, Policy
from dsvla_jax.ranges import at_least, check_fields
from dsvla_jax.sim.environment import Environment
from dsvla_jax.sim.seeds import episode_keys
from dsvla_jax.sim.tasks import select_tasks
from dsvla_jax.types import Action, Camera, Observation, split_cameras

SHOWN = 480  # pixels a side of a picture on the page
NUMBERS = ("x", "y", "z", "qx", "qy", "qz", "qw", "gripper")


@dataclasses.dataclass(frozen=True)
class Options:
    """Which run, on which episode."""

    run: tyro.conf.Positional[Path]
    """The run folder that train.py wrote."""
    task: str = ""
    """The run's first task if not given."""
    seed: int = 0
    """Number of the episode, none of which was demonstrated."""
    out: Path | None = None
    """The page; RUN/demo.html if not given."""

    def __post_init__(self) -> None:
        check_fields(self, "", seed=at_least(0))


@dataclasses.dataclass(frozen=True)
class Step:
    """One keyframe: pictures as data URIs, and rows (number, value, probability) for each arm."""

    tokens: str
    target: str
    prompt: str
    answer: str
    numbers: list[list[tuple[str, str, float]]]


def draw_tokens(rgb: np.ndarray, centers: np.ndarray, patches: np.ndarray, camera: Camera, grid: int) -> np.ndarray:
    """Draws the enlarged picture with each 3D token's centre (G, 3) joined to the middle of its patch (G,).

    Patches that have tokens are outlined. A token of the workspace's far side is blue, of the near side yellow.
    """
    height, width = rgb.shape[:2]
    picture = cv2.resize(rgb, (SHOWN, SHOWN), interpolation=cv2.INTER_NEAREST)
    pixels, depth = (np.asarray(x) for x in project(jnp.asarray(centers), camera))
    places = (pixels + 0.5) * [SHOWN / width, SHOWN / height]
    cell = SHOWN / grid
    for patch in np.unique(patches):
        row, column = divmod(int(patch), grid)
        corners = [(round(x * cell), round(y * cell)) for x, y in ((column, row), (column + 1, row + 1))]
        cv2.rectangle(picture, corners[0], corners[1], (255, 255, 255), 1)
    if not len(depth):
        return picture
    near = (depth.max() - depth) / max(float(np.ptp(depth)), 1e-6)
    for place, patch, closeness in zip(places, patches, near, strict=True):
        row, column = divmod(int(patch), grid)
        middle = (round((column + 0.5) * cell), round((row + 0.5) * cell))
        point = (round(float(place[0])), round(float(place[1])))
        colour = (round(255 * closeness), round(200 * closeness), round(255 * (1 - closeness)))
        cv2.line(picture, point, middle, colour, 1, cv2.LINE_AA)
        cv2.circle(picture, point, 4, colour, -1, cv2.LINE_AA)
    return picture


def draw_keypoints(
    picture: np.ndarray, keypoints: np.ndarray, camera: Camera, image_size: tuple[int, int]
) -> np.ndarray:
    """Crosses, enlarged likewise, at points (N, 3) before the camera."""
    pixels, depth = map(np.asarray, project(jnp.asarray(keypoints), camera))
    picture = picture.copy()
    for place in (pixels[depth > 0] + 0.5) * [SHOWN / image_size[1], SHOWN / image_size[0]]:
        point = (round(float(place[0])), round(float(place[1])))
        for colour, thickness in (((0, 0, 0), 4), ((60, 255, 60), 2)):
            cv2.drawMarker(picture, point, colour, cv2.MARKER_TILTED_CROSS, 18, thickness, cv2.LINE_AA)
    return picture


def film_picture(rgb: np.ndarray) -> np.ndarray:
    """The pictures uint8 (C, H, W, 3) of one moment one below the other, all 192 pixels a side."""
    return np.concatenate([cv2.resize(frame, (192, 192), interpolation=cv2.INTER_NEAREST) for frame in rgb])


def describe(policy: Policy, seen: Observation, instruction: str, near: np.ndarray, decision: Decision) -> Step:
    """One turn of the only robot of a batch. near: the active keypoint of each arm, (A, 3)."""
    encoding: EncodingConfig = policy.config.encoding
    one = jax.tree.map(lambda x: np.asarray(x)[0], seen)
    target = np.asarray(decision.action.pose)[0]
    centers, patches = np.zeros((0, 3), np.float32), np.zeros(0, int)
    if encoding.use_points:
        tokens = jax.jit(cloud_tokens, static_argnums=1)(seen.pictures, encoding)
        centers, patches = (np.asarray(x)[0] for x in tokens[1:])
    of_camera, patch = np.divmod(patches, encoding.grid**2)
    with_tokens, with_target = [], []
    for number, picture in enumerate(split_cameras(one.pictures)):
        rgb, camera, size = picture.rgb, picture.camera, picture.rgb.shape[:2]
        mine = of_camera == number
        with_tokens.append(draw_tokens(rgb, centers[mine], patch[mine], camera, encoding.grid))
        enlarged = cv2.resize(rgb, (SHOWN, SHOWN), interpolation=cv2.INTER_NEAREST)
        scale = np.diag([SHOWN / size[1], SHOWN / size[0], 1.0]).astype(np.float32)
        scaled = dataclasses.replace(camera, intrinsics=scale @ camera.intrinsics)
        marked = mark_targets(enlarged, target[:, :3], scaled)
        with_target.append(draw_keypoints(marked, near, camera, size) if encoding.use_keypoints else marked)
    # Poses come without probabilities.
    sure = np.ones((len(target), len(NUMBERS))) if decision.log_probs is None else np.exp(decision.log_probs[0])
    bins = parse_answer(decision.texts[0], len(target), encoding.style)
    return Step(
        tokens=png_data(np.concatenate(with_tokens, axis=1)),
        target=png_data(np.concatenate(with_target, axis=1)),
        prompt=instruction if policy.config.baseline else build_prompt(encoding, instruction, one.robot, near),
        answer=decision.texts[0],
        numbers=[
            [(name, str(bins[arm, i]), float(sure[arm, i])) for i, name in enumerate(NUMBERS)]
            for arm in range(len(target))
        ],
    )


def main(options: Options) -> None:
    """Runs the episode and writes the page."""
    experiment = load_experiment(options.run / "config.json")
    data = experiment.data
    require_simulated(experiment, options.run)
    task, *others = select_tasks((options.task,) if options.task else data.tasks[:1])
    if options.task and others:
        raise UserError(f"--task: expected one task, got {options.task!r}; the first of its tasks is {task}")
    out = options.out or options.run / "demo.html"
    require_writable(out.parent)
    policy = dsvla_jax.policy.load_policy(options.run)
    environment = Environment(task, image_size=data.image_size, cameras=data.cameras)
    print(f"{task}, episode {options.seed}: compiling takes a minute the first time", flush=True)
    state = environment.reset(episode_keys(0, "eval", task, options.seed, 1))
    steps: list[Step] = []

    def act(seen: Observation, instructions: Sequence[str], near: np.ndarray) -> tuple[Action, list[str]]:
        decision = policy.decide(seen, instructions, near)
        steps.append(describe(policy, seen, instructions[0], near[0], decision))
        print(f"keyframe {len(steps)}: {decision.texts[0]}", flush=True)
        return decision.action, decision.texts

    find = keypoint_source(experiment.keypoints, environment)
    (ending,) = run_episodes(environment, act, state, find_keypoints=find(state) if find else None)
    write_html(
        out,
        Path(__file__).with_name("demo.html.jinja"),
        task=task,
        run=str(options.run),
        seed=options.seed,
        ending=ending,
        steps=steps,
        film=[png_data(film_picture(view.rgb)) for view in ending.views],
    )
    print(f"{'success' if ending.success else ending.reason}: {out}")


if __name__ == "__main__":
    with fail_with_message():
        parsed = parse_options(Options, prog="python -m dsvla_jax.evaluation.demo", description=__doc__)
        configure_jax()
        main(parsed)
